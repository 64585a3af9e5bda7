//! The place where the bytes of a sensor come from: a device file or an address.

use std::fmt;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::{Deserialize, Serialize, Serializer};

/// A port, as `port` of a configuration names it.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Deserialize)]
#[serde(try_from = "String")]
pub enum Port {
    /// A serial port, or a pty.
    Device(PathBuf),
    /// `tcp://HOST:PORT`: the daemon connects there.
    Tcp(String),
    /// `udp://ADDRESS:PORT`: the daemon receives datagrams there.
    Udp(SocketAddr),
}

impl Port {
    /// The path of the device file, if the port has one.
    pub fn device(&self) -> Option<&Path> {
        match self {
            Self::Device(path) => Some(path),
            Self::Tcp(_) | Self::Udp(_) => None,
        }
    }
}

impl Default for Port {
    /// No port yet.
    fn default() -> Self {
        Self::Device(PathBuf::new())
    }
}

impl From<PathBuf> for Port {
    fn from(path: PathBuf) -> Self {
        Self::Device(path)
    }
}

impl FromStr for Port {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let error = |expected: &str| format!("found {text:?}, expected {expected}");
        if let Some(address) = text.strip_prefix("tcp://") {
            let is_host = |host: &str| {
                let is_part = |c: char| c.is_ascii_graphic() && c != '/';
                !host.is_empty() && host.chars().all(is_part)
            };
            return match address.rsplit_once(':') {
                Some((host, port))
                    if is_host(host) && port.parse().is_ok_and(|port: u16| port > 0) =>
                {
                    Ok(Self::Tcp(address.to_owned()))
                }
                _ => Err(error("tcp://HOST:PORT, such as \"tcp://192.168.7.9:4001\"")),
            };
        }
        if let Some(address) = text.strip_prefix("udp://") {
            return match address.parse() {
                Ok(address) if SocketAddr::port(&address) > 0 => Ok(Self::Udp(address)),
                _ => Err(error(
                    "udp://ADDRESS:PORT with an address of this machine, such as \"udp://0.0.0.0:4001\"",
                )),
            };
        }
        if text.contains("://") {
            return Err(error(
                "a device file, tcp://HOST:PORT or udp://ADDRESS:PORT",
            ));
        }
        Ok(Self::Device(text.into()))
    }
}

impl TryFrom<String> for Port {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl Serialize for Port {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Device(path) => path.serialize(serializer),
            Self::Tcp(_) | Self::Udp(_) => serializer.collect_str(self),
        }
    }
}

impl fmt::Display for Port {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Device(path) => path.display().fmt(f),
            Self::Tcp(address) => write!(f, "tcp://{address}"),
            Self::Udp(address) => write!(f, "udp://{address}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_is_a_device_or_an_address_and_is_written_as_it_was_read() {
        for text in [
            "/dev/ttyUSB0",
            "port",
            "tcp://localhost:4001",
            "tcp://[::1]:4001",
            "udp://0.0.0.0:4001",
            "udp://[::1]:4001",
        ] {
            let port: Port = text.parse().unwrap();
            assert_eq!(port.to_string(), text);
            assert_eq!(port.device().is_some(), !text.contains("://"), "{text}");
        }
        for (text, expected) in [
            ("tcp://localhost", "expected tcp://HOST:PORT"),
            ("tcp://host:0", "expected tcp://HOST:PORT"),
            ("tcp://a\u{202e}:1", "expected tcp://HOST:PORT"),
            ("udp://localhost:4001", "expected udp://ADDRESS:PORT"),
            ("udp://0.0.0.0:0", "expected udp://ADDRESS:PORT"),
            ("http://host:80", "expected a device file, tcp://"),
        ] {
            let error = text.parse::<Port>().unwrap_err();
            assert!(error.contains(expected), "{error}");
            assert!(error.starts_with(&format!("found {text:?}")), "{error}");
        }
    }
}
