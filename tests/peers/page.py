#!/usr/bin/env python3
"""The live page in a real Chromium.

    apt-get install chromium chromium-driver
    python -m venv venv && venv/bin/pip install selenium
    venv/bin/python tests/peers/page.py target/debug/hardnessd [--pictures DIRECTORY]

Claims: events arrive and are drawn; a silent and a lost sensor show within 1 s, on their tabs too, and
no old value stands as a current one: map and verdict are grey, and the scale stays; a reload loses no
curve, press or verdict; what comes late,
after a connection broke, is shown as old as it is, whatever the browser's clock says; force against
approach is drawn where an arm's positions come, and hidden elsewhere; sensors can be chosen; a phone of
360 px is wide enough; no console error and no breach of the page's
policy; what a person says that they press is told to the daemon and counted; words are explained; a daemon that goes is said, and the page finds it again by itself. With --pictures it leaves
one of each state, light, dark and narrow.
"""

import datetime
import json
import os
import re
import shutil
import signal
import sys
import time
import urllib.request

from bench import Bench, free_port, wait_for
from selenium import webdriver
from selenium.webdriver.common.by import By

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
SHOWS_WITHIN_S = 1.0

# Writes down when a text first matched, on the page's own clock: no question of ours delays it.
WATCH = """
window.seen = {};
new MutationObserver(() => {
  for (const [id, text] of [["state", "live"], ["state", "stale"], ["state", "lost"]]) {
    const key = id + text;
    if (document.getElementById(id).textContent === text) { window.seen[key] ??= Date.now(); }
    else { delete window.seen[key]; }
  }
}).observe(document.body, { subtree: true, childList: true, characterData: true });
"""


class Page:
    def __init__(self, pictures):
        options = webdriver.ChromeOptions()
        for argument in [
            "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", "--hide-scrollbars",
        ]:
            options.add_argument(argument)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        # Named, so that nothing is looked for on the network.
        service = webdriver.ChromeService(shutil.which("chromedriver"))
        self.driver = webdriver.Chrome(options=options, service=service)
        self.pictures = pictures

    def look(self, width=1180, height=1240, scheme="dark"):
        """As wide and as dark as the reader has it."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        time.sleep(0.3)

    def picture(self, name):
        if self.pictures:
            self.driver.save_screenshot(os.path.join(self.pictures, f"{name}.png"))

    def text(self, id):
        return self.driver.find_element(By.ID, id).text

    def shown(self, id):
        return self.driver.find_element(By.ID, id).is_displayed()

    def run(self, script):
        return self.driver.execute_script(script)

    def seen(self, id, text):
        """When `id` came to say `text`, in seconds since the epoch."""
        return wait_for(f"{id} {text}", lambda: self.run(f"return seen['{id}{text}']")) / 1000

    def complaints(self):
        """What stands in the console, but for what comes of this script's reading the map back."""
        return [
            entry
            for entry in self.driver.get_log("browser")
            if entry["level"] != "INFO" and "willReadFrequently" not in entry["message"]
        ]

    def tab(self, name):
        """What the tab of a sensor says of it."""
        return self.driver.find_element(By.XPATH, f"//nav/button[text()='{name}']/small").text

    def colour(self, id):
        return self.driver.find_element(By.ID, id).value_of_css_property("color")

    def colours(self):
        """The colours of the map, as triples of red, green and blue."""
        found = self.run("""
            const map = document.getElementById("heat");
            const { data } = map.getContext("2d").getImageData(0, 0, map.width, map.height);
            const found = new Set();
            for (let at = 0; at < data.length; at += 4) { found.add(data.slice(at, at + 3).join()); }
            return [...found];""")
        return [tuple(map(int, colour.split(","))) for colour in found]

    def curve(self):
        """Over what share of the width the curve of force against approach is drawn."""
        return self.run("""
            const canvas = document.getElementById("way"), { width, height } = canvas, from = Math.round(width / 10);
            const { data } = canvas.getContext("2d").getImageData(from, 0, width - from, height);
            const columns = new Set();
            for (let at = 0; at < data.length; at += 4) {
              const c = data.slice(at, at + 3);
              if (data[at + 3] && Math.max(...c) - Math.min(...c) > 60) { columns.add(at / 4 % (width - from)); }
            }
            return columns.size / width;""")


def nothing_stands_as_current(page):
    assert page.shown("veil")
    for id in ["force", "area", "peak", "press", "rate"]:
        assert page.text(id) == "–", f"{id} still says {page.text(id)}"
    assert all(max(colour) - min(colour) <= 2 for colour in page.colours())
    # The headline of the last verdict, too.
    assert page.colour("label") == page.colour("facts")
    assert page.text("age").endswith("ago")


def events_arrive(page, bench, sensors):
    wait_for("live", lambda: page.text("state") == "live")
    wait_for("a press", lambda: page.text("press").startswith("#"))
    wait_for("colours", lambda: len(page.colours()) > 6)
    assert not page.shown("veil") and not page.shown("alarm")
    assert (page.tab("forearm"), page.tab("wrist")) == ("live", "live")
    wait_for("a verdict", lambda: page.text("label") not in ("", "none yet"))
    wait_for("a verdict that is sure", lambda: page.colour("label") != page.colour("facts"))
    assert re.match(r"Shore \d+ to \d+, \d+ taxels", page.text("facts")), page.text("facts")
    wait_for("several verdicts", lambda: len(page.driver.find_elements(By.CSS_SELECTOR, "#rows tr")) > 1)
    before = int(page.text("frames").replace("\u202f", ""))
    wait_for("more frames", lambda: int(page.text("frames").replace("\u202f", "")) > before)
    assert page.text("robot") == "arm-7" and "damaged" in page.driver.page_source
    for scheme in ["light", "dark"]:
        page.look(scheme=scheme)
        page.picture(f"live-{scheme}")


def a_verdict_in_words(page):
    """The same words as the tools of the terminal."""
    with open(os.path.join(ROOT, "fixtures/answers.json")) as table:
        table = json.load(table)
    script = """
        const before = hello;
        try { hello = arguments[0].hello; return arguments[0].cases.map((c) => [answer(c.verdict), isWeak(c.verdict)]); }
        finally { hello = before; }"""
    said = page.driver.execute_script(script, table)
    assert said == [[case["text"], case["is_weak"]] for case in table["cases"]], said
    said = page.driver.execute_script("return arguments[0].map((c) => shoreOf(c.shore))", table["shores"])
    assert said == [case["text"].replace("+-", "±") for case in table["shores"]], said


def what_is_pressed_is_counted(page, bench):
    """Each press is of another material, so a level is right now and then."""
    page.driver.find_element(By.XPATH, "//*[@id='truth']/button[text()='hard']").click()
    wait_for("no verdict yet, or some", lambda: page.text("tally"))
    name = page.driver.find_element(By.ID, "object")
    name.send_keys("cup\n")
    tally = wait_for("counted", lambda: re.match(r"(\d+) of (\d+) right, (\d+) wrong", page.text("tally")))
    assert int(tally[1]) + int(tally[3]) <= int(tally[2]), tally[0]
    assert not page.text("told"), page.text("told")
    with urllib.request.urlopen(f"http://{bench.address('http')}/api/status") as answer:
        context = json.load(answer)["sensors"][0]["last"]["context"]
    assert context == {"sensor": "forearm", "level": 1, "object": "cup"}, context
    page.picture("score-dark")


def words_are_explained(page):
    page.driver.find_element(By.CSS_SELECTOR, "[data-word=damaged]").click()
    assert "checksum" in page.text("meaning"), page.text("meaning")
    page.picture("word-dark")
    page.driver.find_element(By.ID, "h-link").click()
    assert not page.shown("meaning")


def force_against_approach_is_drawn(page):
    wait_for("force against approach", lambda: page.shown("approach"))
    wait_for("its press", lambda: re.search(r"press \d+", page.text("way-press")))
    wait_for("the curve", lambda: page.curve() > 0.3)
    page.run("document.getElementById('approach').scrollIntoView()")
    page.picture("approach-dark")
    page.run("scrollTo(0, 0)")


def fits_a_phone(page):
    page.look(width=360, height=1500, scheme="light")
    wide = page.run("return document.documentElement.scrollWidth")
    assert wide <= 360, f"{wide} px wide"
    top = "document.getElementById('{}').getBoundingClientRect().top"
    assert page.run(f"return {top.format('verdict')} < {top.format('heat')}"), "the verdict does not come first"
    page.picture("live-narrow")
    page.look()


def a_reload_loses_nothing(page):
    known = """
        const s = sensors.get(chosen);
        return s && s.trace.length && s.verdicts.length
          ? [s.trace[0].t, s.verdicts.map((v) => v.event.press), s.presses.map((p) => p.number)] : null;"""
    first, verdicts, presses = page.run(known)
    page.driver.refresh()

    def is_all_there():
        now = page.run(known)
        return now and now[0] <= first and verdicts[-1] in now[1] and set(presses) <= set(now[2])

    wait_for("what was there before the reload", is_all_there)
    page.driver.find_element(By.ID, "span").click()
    assert page.text("span") == "2 min", page.text("span")
    page.look()
    page.picture("two-minutes-dark")


def loss_shows_at_once(page, bench, sensors):
    forearm = sensors["forearm"]
    page.run(WATCH)
    delays = {}
    scale = page.text("most")
    stopped = time.time()
    forearm.send_signal(signal.SIGSTOP)
    delays["stale"] = page.seen("state", "stale") - stopped
    time.sleep(0.5)
    nothing_stands_as_current(page)
    assert (page.tab("forearm"), page.tab("wrist")) == ("stale", "live")
    # The map keeps a scale. Presses may come into its span since, and leave it.
    assert float(page.text("most").split()[0]) > 0, (scale, page.text("most"))
    page.picture("stale-dark")
    forearm.send_signal(signal.SIGCONT)
    wait_for("live again", lambda: page.text("state") == "live")
    killed = time.time()
    forearm.kill()
    delays["lost"] = page.seen("state", "lost") - killed
    time.sleep(1.5)
    nothing_stands_as_current(page)
    page.picture("lost-dark")
    page.look(width=360, height=1500, scheme="light")
    page.picture("lost-narrow")
    page.look()
    for state, delay in delays.items():
        assert delay < SHOWS_WITHIN_S, f"{state} shows after {delay:.3f} s"
    return {state: round(delay, 3) for state, delay in delays.items()}


def what_comes_late_is_as_old_as_it_is(page, bench, sensors):
    """The connection breaks, a verdict is missed, its sensor falls silent, the page connects again."""
    forearm = sensors["forearm"]

    def last():
        with urllib.request.urlopen(f"http://{bench.address('http')}/api/status") as answer:
            return json.load(answer)["sensors"][0]["last"]

    shown = wait_for("a verdict", lambda: re.match(r"press (\d+),", page.text("when")))
    page.run("source.close()")
    wait_for("a verdict that is missed", lambda: last()["press"] > int(shown[1]) + 1)
    forearm.send_signal(signal.SIGSTOP)
    missed = last()
    time.sleep(4)
    # The browser's clock is put forward an hour, and the page hears of the daemon's once more.
    page.run("const real = Date.now; Date.now = () => real() + 3600e3; window.real = real;")
    before = page.run("return heard")
    wait_for("a status", lambda: page.run("return heard") > before)
    page.run("listen()")
    said = wait_for("what was missed", lambda: re.match(rf"press {missed['press']}, (\S+)\ss ago", page.text("when")))
    age = time.time() - datetime.datetime.fromisoformat(missed["time"]).timestamp() - missed["age_at_publish_ms"] / 1000
    assert abs(float(said[1]) - age) < 2, f"{said[0]}, expected {age:.1f} s"
    numbers = [row.text.split()[1] for row in page.driver.find_elements(By.CSS_SELECTOR, "#rows tr")]
    assert numbers[0].startswith(f"#{missed['press']}"), numbers
    veil = page.text("veil-text")
    silent = re.match(r"stale · last frame (\d+)", veil)
    assert silent and int(silent[1]) >= 4, veil
    page.picture("late-dark")
    page.run("Date.now = window.real")
    forearm.send_signal(signal.SIGCONT)
    wait_for("live again", lambda: page.text("state") == "live" and not page.shown("veil"))


def sensors_can_be_chosen(page):
    assert page.tab("forearm") == "lost"
    wrist = page.driver.find_element(By.XPATH, "//nav/button[text()='wrist']")
    wrist.click()
    wait_for("the wrist", lambda: page.text("state") == "live" and not page.shown("veil"))
    chosen = page.driver.find_element(By.CSS_SELECTOR, "nav [aria-pressed=true]")
    assert chosen.text.startswith("wrist")
    wait_for("its verdict", lambda: page.text("label") not in ("", "none yet"))
    # Nobody sends positions of its arm.
    assert not page.shown("approach")


def the_daemon_may_go_and_come(page, bench, daemon):
    daemon.kill()
    daemon.wait()
    wait_for("the alarm", lambda: page.shown("alarm"))
    wait_for("the veil", lambda: page.shown("veil"))
    time.sleep(1)
    nothing_stands_as_current(page)
    assert page.text("daemon") == "daemon not reachable"
    page.look(scheme="light")
    page.picture("no-daemon-light")
    page.look()
    bench.daemon()
    wait_for("the daemon", lambda: not page.shown("alarm") and page.text("daemon") == "daemon connected")
    # What the reader chose stays chosen.
    wait_for("the wrist", lambda: page.text("state") == "live" and "wrist" in page.text("name"))


def main(binary, pictures):
    if pictures:
        os.makedirs(pictures, exist_ok=True)
    # The same port after a restart, as in a configuration.
    http = f'[http]\nlisten = "127.0.0.1:{free_port()}"\nset_context = true\n'
    page = Page(pictures)
    try:
        with Bench(binary, ("forearm", "wrist"), more=http) as bench:
            motion = ("--motion", bench.path("control.sock"))
            sensors = {"forearm": bench.sensor("forearm", *motion), "wrist": bench.sensor("wrist", "--seed", "4")}
            daemon = bench.daemon()
            page.look()
            page.driver.get(f"http://{bench.address('http')}/")
            events_arrive(page, bench, sensors)
            a_verdict_in_words(page)
            what_is_pressed_is_counted(page, bench)
            words_are_explained(page)
            force_against_approach_is_drawn(page)
            fits_a_phone(page)
            a_reload_loses_nothing(page)
            what_comes_late_is_as_old_as_it_is(page, bench, sensors)
            delays = loss_shows_at_once(page, bench, sensors)
            sensors_can_be_chosen(page)
            complaints = page.complaints()
            assert not complaints, complaints
            # From here on the browser itself complains that nobody answers.
            the_daemon_may_go_and_come(page, bench, daemon)
            policy = [entry for entry in page.complaints() if "Content Security" in entry["message"]]
            assert not policy, policy
            print(f"no complaint in the console; shown after {delays} s")
    finally:
        page.driver.quit()


if __name__ == "__main__":
    binary, *pictures = sys.argv[1:]
    main(binary, pictures[-1] if pictures else None)
