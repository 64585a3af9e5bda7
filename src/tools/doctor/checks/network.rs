//! Whether the bytes of a sensor can come over the network.

use std::io::{Error, ErrorKind};
use std::net::{IpAddr, SocketAddr, ToSocketAddrs};
use std::path::Path;

use super::{Fault, service};
use crate::daemon::port::Port;
use crate::daemon::serial;

/// The faults of a port that is no device. It connects, or binds the address, for a moment.
pub(in crate::tools::doctor) fn faults(root: &Path, port: &Port) -> Vec<Fault> {
    let own = serial::probe(port).err().map(|error| Fault {
        what: serial::reason(port, &error),
        cure: cure(port, &error),
    });
    let addresses: Vec<IpAddr> = match port {
        Port::Tcp(address) => {
            let found = address.to_socket_addrs();
            found.into_iter().flatten().map(|one| one.ip()).collect()
        }
        Port::Udp(address) => vec![SocketAddr::ip(address)],
        Port::Device(_) => Vec::new(),
    };
    let is_outside = |address: &IpAddr| !address.is_loopback();
    let forbidden = addresses.iter().any(is_outside) && service::forbids_network(root);
    let forbidden = forbidden.then(|| Fault {
        what: "the service may reach this machine only (IPAddressDeny=any)".to_owned(),
        cure: "`sudo systemctl edit hardnessd`, add `[Service]` and `IPAddressAllow=` with the address of \
               the sensor, then `sudo systemctl restart hardnessd`"
            .to_owned(),
    });
    own.into_iter().chain(forbidden).collect()
}

fn cure(port: &Port, error: &Error) -> String {
    let cure = match (port, error.kind()) {
        (Port::Udp(_), ErrorKind::AddrInUse) => {
            "another program receives there, such as the running daemon: `sudo ss -ulpn` names it"
        }
        (Port::Udp(_), ErrorKind::AddrNotAvailable) => {
            "no interface of this machine has the address: use 0.0.0.0, or one of `ip address`"
        }
        (_, ErrorKind::ConnectionRefused) => {
            "nothing listens there: start the server on the board or the other computer, or correct the port"
        }
        _ => "correct the address, or look for the way there with `ping`",
    };
    cure.to_owned()
}
