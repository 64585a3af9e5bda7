//! The `[publish]` tables: all ways to publish events, except HTTP.

use std::env;
use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::directory_of_service;
use hardnessd_core::range::from_to;
use hardnessd_core::settings;

settings! {
    /// The `[publish]` tables.
    pub struct Publish {
        /// The Unix socket.
        pub unix: Unix = Unix::default();
        /// The same protocol over TCP. Without the table, it is off.
        pub tcp: Option<Tcp>;
        /// A server for Foxglove and Lichtblick. Without the table, it is off. It needs the feature
        /// `foxglove`.
        pub foxglove: Option<Foxglove>;
        /// The keys of a zenoh session. Without the table, it is off. It needs the feature `zenoh`.
        pub zenoh: Option<Zenoh>;
        /// The topics of a ROS 2 node. Without the table, it is off. It needs the feature `ros2`.
        pub ros2: Option<Ros2>;
        /// The same topics for nodes of `rmw_zenoh`. Without the table, it is off. It needs the feature `zenoh`.
        pub rmw_zenoh: Option<RmwZenoh>;
    }
}

/// A port of this machine alone.
fn here(port: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], port))
}

settings! {
    /// The `[publish.tcp]` table.
    pub struct Tcp {
        /// The address and port to listen on.
        pub listen: SocketAddr = here(8255);
    }
}

settings! {
    /// The `[publish.foxglove]` table. The applications propose this port.
    pub struct Foxglove {
        /// The address and port to listen on.
        pub listen: SocketAddr = here(8765);
    }
}

settings! {
    /// The `[http]` table.
    pub struct Http {
        /// The address and port to listen on.
        pub listen: SocketAddr = here(8256);
        /// Whether the live page may set what is being pressed, as `object` and `level` of the context.
        pub set_context: bool = false;
    }
}

settings! {
    /// The `[publish.zenoh]` table. A session uses only the endpoints of the table, and does not look
    /// for other peers.
    pub struct Zenoh {
        /// Endpoints to listen on, such as `tcp/127.0.0.1:7447`.
        pub listen: Vec<String> = vec!["tcp/127.0.0.1:7447".to_owned()];
        /// Endpoints of routers or peers to connect to. The session retries until they answer.
        pub connect: Vec<String> = Vec::new();
        /// The part after `tactile/` in every key. The default is the robot's name.
        site: Option<String>;
    }
}

impl Zenoh {
    /// The part after `tactile/` in every key.
    pub fn site<'a>(&'a self, robot: &'a str) -> &'a str {
        self.site.as_deref().unwrap_or(robot)
    }

    /// The address of an endpoint `tcp/HOST:PORT`: `HOST:PORT`.
    pub fn address(endpoint: &str) -> Option<&str> {
        let address = endpoint.strip_prefix("tcp/")?;
        let (_host, port) = address.rsplit_once(':')?;
        port.parse::<u16>().ok().map(|_| address)
    }
}

settings! {
    /// The `[publish.ros2]` table.
    pub struct Ros2 {
        /// The domain ID. [`domain_id`] has the default.
        pub domain_id: Option<u16>;
        /// Namespace of the node and its topics.
        pub namespace: String = "/".to_owned();
        /// Addresses of the interfaces to use. An empty list means every interface, as in ROS 2.
        pub networks: Vec<IpAddr> = Vec::new();
    }
}

settings! {
    /// The `[publish.rmw_zenoh]` table. The session looks for nodes at its routers only.
    pub struct RmwZenoh {
        /// Endpoints of ROS's routers (`rmw_zenohd`). The session retries until they answer.
        pub connect: Vec<String> = vec!["tcp/127.0.0.1:7447".to_owned()];
        /// Endpoints to listen on. A port of 0 is any free port.
        pub listen: Vec<String> = vec!["tcp/127.0.0.1:0".to_owned()];
        /// The domain ID. [`domain_id`] has the default.
        pub domain_id: Option<u16>;
        /// Namespace of the node and its topics.
        pub namespace: String = "/".to_owned();
        /// Whether the topics' keys have the hash of the message type. They have none in ROS 2 Humble.
        pub type_hashes: bool = true;
    }
}

/// The domain ID of ROS: the configured one, else that of the environment, else 0.
///
/// # Errors
///
/// Returns what `$ROS_DOMAIN_ID` is, if it is not a number.
pub fn domain_id(configured: Option<u16>) -> Result<u16, String> {
    match (configured, env::var("ROS_DOMAIN_ID")) {
        (Some(id), _) => Ok(id),
        (None, Ok(text)) if !text.is_empty() => {
            text.parse().map_err(|_| format!("$ROS_DOMAIN_ID {text:?}"))
        }
        (None, _) => Ok(0),
    }
}

settings! {
    /// The `[publish.unix]` table.
    pub struct Unix {
        /// Whether the daemon opens its Unix sockets.
        pub enabled: bool = true;
        /// The path of the socket. [`Unix::path`] has the default.
        pub path: Option<PathBuf>;
        /// The permissions of the socket's file.
        pub mode: Mode = Mode(0o660);
        /// The path of the control socket. The default is `control.sock` beside the other socket.
        pub(super) control_path: Option<PathBuf>;
        /// The permissions of the control socket's file.
        pub control_mode: Mode = Mode(0o600);
        /// The group of the control socket's file: a name, or a number. Without it, it is the daemon's own.
        pub control_group: Option<String>;
        /// The most subscribers at a time, on each socket and on TCP. No process may have more open
        /// files.
        pub max_clients: usize = 256, in from_to((1.0, 1e6), "");
    }
}

impl Unix {
    /// The path of the socket: the configured one, else the first of [`Unix::places`].
    pub fn path(&self) -> PathBuf {
        let configured = self.path.clone();
        configured.unwrap_or_else(|| Self::places().swap_remove(0))
    }

    /// The default paths of a socket that apply here, the preferred one first: in the service's
    /// runtime directory, in the user's runtime directory, and in `/run/hardnessd`.
    pub fn places() -> Vec<PathBuf> {
        let service = directory_of_service("RUNTIME_DIRECTORY");
        let user = env::var("XDG_RUNTIME_DIR").ok();
        let user = user.filter(|directory| !directory.is_empty());
        let user = user.map(|directory| Path::new(&directory).join("hardnessd"));
        let directories = service.into_iter().chain(user);
        directories
            .chain([PathBuf::from("/run/hardnessd")])
            .map(|directory| directory.join("events.sock"))
            .collect()
    }

    /// The path of the control socket.
    pub fn control_path(&self) -> PathBuf {
        let beside = || self.path().with_file_name("control.sock");
        self.control_path.clone().unwrap_or_else(beside)
    }
}

/// Permissions of a file, written in octal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Mode(pub u32);

impl TryFrom<String> for Mode {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        match u32::from_str_radix(&text, 8) {
            Ok(mode) if mode <= 0o777 => Ok(Self(mode)),
            _ => Err(format!(
                "found {text:?}, expected octal permissions such as \"0660\""
            )),
        }
    }
}

impl From<Mode> for String {
    fn from(mode: Mode) -> Self {
        format!("{:04o}", mode.0)
    }
}
