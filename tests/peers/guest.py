"""A Debian of the host's release in qemu, with a serial film at its USB and its PCI bus."""

import base64
import glob
import hashlib
import json
import os
import select
import shutil
import socket
import subprocess
import tempfile
import threading
import time
import tty

import bench

CACHE = os.path.join(
    os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache")), "hardnessd", "machine"
)
# The kernel of linux-image-* has ftdi_sio; ModemManager is there to be kept away.
PACKAGES = "systemd systemd-sysv udev dbus kmod procps initramfs-tools python3 modemmanager".split()
# By Debian's name of an architecture: qemu's, its machine and processor (for Arm a Raspberry Pi 4's), and
# what Linux calls the port that has the console and the first one at the PCI bus.
ARCHITECTURES = {
    "amd64": ("x86_64", "pc", "max", "ttyS0", "ttyS1"),
    "arm64": ("aarch64", "virt", "cortex-a72", "ttyAMA0", "ttyS0"),
}
# Runs what comes, one command a line, and answers with its exit code and output, in base64; 124: it
# hung.
AGENT = """#!/bin/bash
until [ -c /dev/virtio-ports/control ]; do sleep 0.2; done
exec 3<>/dev/virtio-ports/control
echo ready >&3
while read -r -u 3 line; do
    output=$(base64 -d <<<"$line" | timeout -k 5 120 bash 2>&1 3>&- | base64 -w 0; exit "${PIPESTATUS[1]}")
    echo "$? $output" >&3
done
"""
SERVICE = """[Unit]
Description=Commands from outside
[Service]
ExecStart=/usr/local/sbin/agent
Environment=HOME=/root LC_ALL=C.UTF-8 DEBIAN_FRONTEND=noninteractive
[Install]
WantedBy=multi-user.target
"""
# What it takes to mount the disk: a search for all that might takes half an hour on an emulated
# processor.
INITRAMFS = {
    "etc/initramfs-tools/conf.d/machine": "MODULES=list",
    "usr/share/initramfs-tools/modules.d/machine": "virtio_pci\nvirtio_blk\next4",
}
# For an emulated processor on a busy machine.
PATIENCE_S = 300
# KVM is there or it is not: where it boots, it does so in seconds.
KVM_PATIENCE_S = 60


def run(*command, **more):
    return bench.run(*command, **more).stdout


def wait_for(what, there):
    return bench.wait_for(what, there, PATIENCE_S)


def image(architecture):
    """The directory with `disk`, `vmlinuz` and `initrd.img`; made once (minutes), then kept."""
    release = run("sh", "-c", '. /etc/os-release; echo "$VERSION_CODENAME"').strip()
    packages = [*PACKAGES, f"linux-image-{architecture}"]
    recipe = "\n".join([release, *packages, AGENT, SERVICE, *INITRAMFS.values()])
    place = os.path.join(CACHE, hashlib.sha256(recipe.encode()).hexdigest()[:12])
    if os.path.isdir(place):
        return place
    print("machine: making the image", flush=True)
    os.makedirs(CACHE, exist_ok=True)
    # The mirrors that this machine's apt uses.
    line = "deb $(REPO_URI) $(RELEASE) $(COMPONENT)"
    sources = run("apt-get", "indextargets", "--format", line, "Created-By: Packages", "Origin: Debian")
    assert sources, "found no Debian mirror in apt's configuration, expected one (apt-get update)"
    with tempfile.TemporaryDirectory(dir=CACHE) as work:
        for name, text in [("agent", AGENT), ("agent.service", SERVICE)]:
            with open(os.path.join(work, name), "w") as file:
                file.write(text)
        hooks = [
            "upload agent /usr/local/sbin/agent", "upload agent.service /etc/systemd/system/agent.service",
            'chroot "$1" chmod 755 /usr/local/sbin/agent', 'chroot "$1" systemctl enable agent',
            'echo machine >"$1/etc/hostname"',
            # Made at the first boot.
            ': >"$1/etc/machine-id"',
        ]
        modules = [
            f'mkdir -p "$1/{os.path.dirname(path)}" && echo "{text}" >"$1/{path}"'
            for path, text in INITRAMFS.items()
        ]
        run(
            "mmdebstrap", "--variant=minbase", f"--architectures={architecture}",
            "--include=" + ",".join(packages),
            "--aptopt=APT::Install-Recommends false",
            *(f"--essential-hook={hook}" for hook in modules),
            *(f"--customize-hook={hook}" for hook in hooks), release, "root.tar", "-",
            input=sources, cwd=work,
        )
        made = os.path.join(work, "made")
        os.mkdir(made)
        unpack = f"""
            mkdir root && tar -xf root.tar -C root
            cp root/boot/vmlinuz-* made/vmlinuz && cp root/boot/initrd.img-* made/initrd.img
            mke2fs -q -t ext4 -d root made/disk 3G
            rm -rf root
        """
        # Owners and device nodes stay what they are, for root and for others.
        fake = [] if os.geteuid() == 0 else ["fakeroot", "--"]
        run(*fake, "sh", "-euc", unpack, cwd=work)
        os.rename(made, place)
    return place


class Cable:
    """What `simulate` sends, brought to a character device of qemu; a pulled one carries nothing."""

    def __init__(self, program, folder, name, *options):
        self.link = os.path.join(folder, f"{name}.pty")
        self.socket = os.path.join(folder, f"{name}.sock")
        self.is_plugged = True
        self.heard = b""
        self.film = subprocess.Popen(
            [program, "simulate", "--link", self.link, *options], stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        wait_for("the film", lambda: os.path.exists(self.link))
        self.pty = os.open(self.link, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.pty)
        self.connect()

    def connect(self):
        """To a qemu that has just been started."""
        self.peer = socket.socket(socket.AF_UNIX)
        self.peer.connect(self.socket)
        threading.Thread(target=self._carry, daemon=True).start()

    def _carry(self):
        while True:
            try:
                there, _, _ = select.select([self.pty, self.peer], [], [])
                if self.peer in there:
                    # Somebody wrote to the film; what is not taken off would stop qemu.
                    self.heard += self.peer.recv(4096) or self._end()
                if self.pty in there:
                    chunk = os.read(self.pty, 4096)
                    if self.is_plugged:
                        self.peer.send(chunk, socket.MSG_DONTWAIT)
            except BlockingIOError:
                # As on a wire: what finds no room is gone.
                pass
            except OSError:
                return

    def _end(self):
        raise ConnectionResetError

    def close(self):
        self.film.terminate()
        self.film.wait()


class Machine:
    """A booted guest. Use it with `with`: it and all it writes end with it."""

    def __init__(self, package, program):
        self.folder = tempfile.mkdtemp()
        self.program = program
        self.processes = []
        self.cables = {}
        self.architecture = run("dpkg-deb", "-f", package, "Architecture").strip()
        name, board, processor, console, self.pci_port = ARCHITECTURES[self.architecture]
        qemu = f"qemu-system-{name}"
        assert shutil.which(qemu), f"found no {qemu}, expected what .ci/machine names"
        place = image(self.architecture)
        disk, load = self.path("disk"), self.path("load.tar")
        backing = ["-F", "raw", "-b", f"{place}/disk"]
        run("qemu-img", "create", "-q", "-f", "qcow2", *backing, disk)
        run("tar", "-cf", load, "-C", os.path.dirname(package), os.path.basename(package))
        self.command = [
            qemu, "-machine", board, "-cpu", processor, "-smp", "2", "-m", "1024",
            "-nodefaults", "-display", "none", "-nic", "none",
            "-kernel", f"{place}/vmlinuz", "-initrd", f"{place}/initrd.img",
            "-append", f"root=/dev/vda rw console={console} quiet",
            "-drive", f"file={disk},format=qcow2,if=virtio,cache=unsafe",
            "-drive", f"file={load},format=raw,if=virtio,readonly=on",
            "-no-reboot", "-serial", f"file:{self.path('console')}",
            "-qmp", f"unix:{self.path('qmp.sock')},server=on,wait=off",
            "-device", "virtio-serial",
            *self.port("control"), "-device", "virtserialport,chardev=control,name=control",
            *self.port("events"), "-device", "virtserialport,chardev=events,name=events",
            *self.port("forearm"), "-device", "qemu-xhci,id=usb",
            *self.port("palm"), "-device", "pci-serial,chardev=palm",
        ]

    def path(self, name):
        return os.path.join(self.folder, name)

    def port(self, name):
        return ["-chardev", f"socket,id={name},path={self.path(name + '.sock')},server=on,wait=off"]

    @staticmethod
    def usb_serial():
        return "usb-serial,id=film,bus=usb.0,chardev=forearm,serial=film7,always-plugged=on"

    def __enter__(self):
        try:
            self._boot()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _boot(self):
        start = time.monotonic()
        # A KVM that can be opened does not boot every kernel.
        own = self.architecture == run("dpkg", "--print-architecture").strip()
        has_kvm = own and os.access("/dev/kvm", os.R_OK | os.W_OK)
        tries = {"kvm": KVM_PATIENCE_S} if has_kvm else {}
        for self.accelerator, patience_s in [*tries.items(), ("tcg", PATIENCE_S)]:
            if self._started(patience_s, "-device", self.usb_serial()):
                break
        else:
            raise AssertionError(f"it does not boot: {self.read('qemu')}{self.read('console')}")
        self.boot_s = time.monotonic() - start
        self.events = self._connect("events", PATIENCE_S)

    def _started(self, patience_s, *more):
        with open(self.path("qemu"), "wb") as log:
            command = [*self.command, "-accel", self.accelerator, *more]
            self.qemu = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            wait_for("qemu", lambda: os.path.exists(self.path("qmp.sock")) or self.qemu.poll())
            self.qmp = self._connect("qmp", patience_s)
            self.replies = self.qmp.makefile()
            self.replies.readline()
            self.tell("qmp_capabilities")
            self.control = self._connect("control", patience_s)
            self.answers = self.control.makefile()
            line = self.answers.readline()
            if line != "ready\n":
                raise ValueError(f"found {line!r}, expected ready")
        except (OSError, ValueError):
            # It has ended, or says nothing.
            self.qemu.kill()
            self.qemu.wait()
            for left in glob.glob(self.path("*.sock")):
                os.unlink(left)
            return False
        return True

    def _connect(self, name, patience_s):
        peer = socket.socket(socket.AF_UNIX)
        peer.settimeout(patience_s)
        peer.connect(self.path(f"{name}.sock"))
        return peer

    def read(self, name):
        """The end of one of its logs, `qemu` or `console`."""
        return open(self.path(name), errors="replace").read()[-3000:]

    def tell(self, command, until="return", **arguments):
        """One command to qemu; waits for its answer, or for the event of that name."""
        self.qmp.sendall(json.dumps({"execute": command, "arguments": arguments}).encode())
        while True:
            answer = json.loads(self.replies.readline())
            assert "error" not in answer, answer
            if until in answer or until == answer.get("event"):
                return

    def ask(self, command, patience_s=PATIENCE_S):
        """Runs a command in the guest, as root: its exit code and what it printed."""
        self.control.settimeout(patience_s)
        self.control.sendall(base64.b64encode(command.encode()) + b"\n")
        code, _, output = self.answers.readline().strip().partition(" ")
        return int(code), base64.b64decode(output).decode()

    def run(self, command, patience_s=PATIENCE_S):
        """The same; it has to end with 0."""
        code, output = self.ask(command, patience_s)
        assert code == 0, (command, code, output[-3000:])
        return output.strip()

    def plug(self):
        self.cables["forearm"].is_plugged = True
        driver, *settings = self.usb_serial().split(",")
        self.tell("device_add", driver=driver, **dict(one.split("=") for one in settings))

    def pull(self):
        self.cables["forearm"].is_plugged = False
        # Its line is free when qemu says that it has gone.
        self.tell("device_del", until="DEVICE_DELETED", id="film")

    def film(self, name, *options):
        """Starts a simulated film at the guest's port of that name."""
        self.cables[name] = Cable(self.program, self.folder, name, *options)

    def __exit__(self, *_):
        for cable in self.cables.values():
            cable.close()
        if hasattr(self, "qemu"):
            self.qemu.kill()
            self.qemu.wait()
        shutil.rmtree(self.folder)
