//! Protection against DNS rebinding: a page from elsewhere must not reach this server under a name
//! of its own.
//!
//! A browser sends in `Host` the host in its address bar. An attacker has to use a name, even if
//! the name resolves to this machine. So this module accepts only addresses, and `localhost`, which
//! always means this machine. It ignores the port: another port comes from a tunnel (`ssh -L`), and
//! does not help an attacker.

use std::net::{IpAddr, SocketAddr};

use hyper::Request;
use hyper::header::HOST;
use hyper::http::uri::Authority;

/// Whether `request` was meant for this server, which listens on `listen` and accepted it at
/// `local`.
pub(super) fn is_ours<B>(request: &Request<B>, listen: SocketAddr, local: SocketAddr) -> bool {
    let mut hosts = request.headers().get_all(HOST).iter();
    let (Some(host), None) = (hosts.next(), hosts.next()) else {
        return false;
    };
    // A host in the request line counts as well (RFC 9112, section 3.2.2).
    let named = request.uri().host();
    let host = host.to_str().ok().and_then(host_of);
    named.is_none_or(|named| accepts(named, listen, local))
        && host.is_some_and(|host| accepts(&host, listen, local))
}

/// The host without its port.
fn host_of(header: &str) -> Option<String> {
    let authority: Authority = header.parse().ok()?;
    // A Host header has no user name.
    (!header.contains('@')).then(|| authority.host().to_owned())
}

fn accepts(host: &str, listen: SocketAddr, local: SocketAddr) -> bool {
    if host.eq_ignore_ascii_case("localhost") {
        return true;
    }
    let literal = host
        .strip_prefix('[')
        .and_then(|host| host.strip_suffix(']'))
        .unwrap_or(host);
    literal.parse::<IpAddr>().is_ok_and(|address| {
        let address = address.to_canonical();
        address.is_loopback()
            || address == listen.ip().to_canonical()
            || address == local.ip().to_canonical()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_addresses_of_this_machine_are_its_host() {
        let listen = "0.0.0.0:8256".parse().unwrap();
        let local = "192.168.7.2:8256".parse().unwrap();
        let asked = |uri: &str, hosts: &[&str]| {
            let request = Request::builder().uri(uri);
            let hosts = hosts.iter();
            let request = hosts.fold(request, |request, host| request.header(HOST, *host));
            is_ours(&request.body(()).unwrap(), listen, local)
        };
        for host in [
            "LocalHost",
            "127.0.0.1:9000",
            "[::1]:8256",
            "192.168.7.2:8256",
            "0.0.0.0:8256",
        ] {
            assert!(asked("/", &[host]), "{host}");
        }
        for host in [
            "localhost.evil.example",
            "192.168.7.3:8256",
            "robot.local",
            "evil@127.0.0.1",
            "",
        ] {
            assert!(!asked("/", &[host]), "{host}");
        }
        assert!(!asked("/", &["localhost", "evil.example"]));
        assert!(!asked("/", &[]));
        assert!(!asked("http://evil.example/", &["localhost"]));
    }
}
