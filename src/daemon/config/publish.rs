//! The `[publish]` tables: where events go, except by HTTP.

use std::collections::BTreeMap;
use std::env;
use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// The `[publish]` tables.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Publish {
    /// The Unix socket.
    pub unix: Unix,
    /// The same protocol over TCP; off unless the table is there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tcp: Option<Tcp>,
    /// A server for Foxglove and Lichtblick; off unless the table is there. Needs the feature
    /// `foxglove`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub foxglove: Option<Foxglove>,
    /// Keys of a zenoh session; off unless the table is there. Needs the feature `zenoh`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zenoh: Option<Zenoh>,
    /// Topics of a ROS 2 node; off unless the table is there. Needs the feature `ros2`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ros2: Option<Ros2>,
}

impl Publish {
    /// Publishes nothing at all.
    pub fn none() -> Self {
        let unix = Unix {
            enabled: false,
            ..Unix::default()
        };
        Self {
            unix,
            ..Self::default()
        }
    }
}

/// The `[publish.tcp]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tcp {
    /// Address and port.
    pub listen: SocketAddr,
}

impl Default for Tcp {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8255)),
        }
    }
}

/// The `[publish.foxglove]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Foxglove {
    /// Address and port.
    pub listen: SocketAddr,
}

impl Default for Foxglove {
    fn default() -> Self {
        // The port that the applications propose.
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8765)),
        }
    }
}

/// The `[publish.zenoh]` table. A session listens and connects where the table says, and does not
/// look for other peers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Zenoh {
    /// Endpoints to listen on, such as `tcp/127.0.0.1:7447`.
    pub listen: Vec<Endpoint>,
    /// Endpoints of routers or peers to connect to. The session retries until they answer.
    pub connect: Vec<Endpoint>,
    /// The part after `tactile/` in every key; by default the robot's name.
    #[serde(skip_serializing_if = "Option::is_none")]
    site: Option<String>,
    /// The key at which the robot says where its arms are; none: it does not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub motion: Option<String>,
}

impl Default for Zenoh {
    fn default() -> Self {
        Self {
            listen: vec![Endpoint("tcp/127.0.0.1:7447".to_owned())],
            connect: Vec::new(),
            site: None,
            motion: None,
        }
    }
}

impl Zenoh {
    /// The part after `tactile/` in every key.
    pub fn site<'a>(&'a self, robot: &'a str) -> &'a str {
        self.site.as_deref().unwrap_or(robot)
    }
}

/// Where a zenoh session listens or connects: `tcp/HOST:PORT`.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Endpoint(String);

impl Endpoint {
    /// `HOST:PORT`.
    pub fn address(&self) -> &str {
        let address = Self::parse(&self.0);
        address.expect("an endpoint is read from a text that is one")
    }

    fn parse(text: &str) -> Option<&str> {
        let address = text.strip_prefix("tcp/")?;
        let (_host, port) = address.rsplit_once(':')?;
        port.parse::<u16>().ok().map(|_| address)
    }
}

/// As it is written in the configuration.
impl fmt::Debug for Endpoint {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(out)
    }
}

/// Text that is no [`Endpoint`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("found {0:?}, expected an endpoint such as \"tcp/127.0.0.1:7447\"")]
pub struct EndpointError(String);

impl TryFrom<String> for Endpoint {
    type Error = EndpointError;

    fn try_from(text: String) -> Result<Self, EndpointError> {
        match Self::parse(&text) {
            Some(_) => Ok(Self(text)),
            None => Err(EndpointError(text)),
        }
    }
}

impl From<Endpoint> for String {
    fn from(endpoint: Endpoint) -> Self {
        endpoint.0
    }
}

/// The `[publish.ros2]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ros2 {
    /// Domain; by default `$ROS_DOMAIN_ID`, else 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    domain_id: Option<u16>,
    /// Namespace of the node and its topics.
    pub namespace: String,
    /// Addresses of the interfaces to use. An empty list means every interface, as in ROS 2.
    pub networks: Vec<IpAddr>,
    /// By sensor: the topic on which the robot says where its arm is.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub motion: BTreeMap<String, String>,
}

impl Default for Ros2 {
    fn default() -> Self {
        Self {
            domain_id: None,
            namespace: "/".to_owned(),
            networks: Vec::new(),
            motion: BTreeMap::new(),
        }
    }
}

impl Ros2 {
    /// The domain: the configured one, else that of the environment, else 0.
    ///
    /// # Panics
    ///
    /// If the configuration was not checked.
    pub fn domain_id(&self) -> u16 {
        let chosen = self.chosen_domain_id();
        chosen.expect("the domain was checked when the configuration was read")
    }

    /// The same before it is checked.
    pub(super) fn chosen_domain_id(&self) -> Result<u16, DomainIdError> {
        match (self.domain_id, env::var("ROS_DOMAIN_ID")) {
            (Some(id), _) => Ok(id),
            (None, Ok(text)) if !text.is_empty() => text.parse().map_err(|_| DomainIdError(text)),
            (None, _) => Ok(0),
        }
    }
}

/// A `$ROS_DOMAIN_ID` that is no number.
#[derive(Debug, thiserror::Error)]
#[error("$ROS_DOMAIN_ID {0:?}")]
pub(super) struct DomainIdError(String);

/// The `[publish.unix]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Unix {
    /// Whether there is one.
    pub enabled: bool,
    /// The path of the socket; [`Unix::path`] has the default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) path: Option<PathBuf>,
    /// Permissions of its file.
    pub mode: Mode,
    /// The path of the control socket; by default `control.sock` beside the other socket.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) control_path: Option<PathBuf>,
    /// Subscribers at a time, on each socket and on TCP.
    pub max_clients: usize,
}

impl Default for Unix {
    fn default() -> Self {
        Self {
            enabled: true,
            path: None,
            mode: Mode(0o660),
            control_path: None,
            max_clients: 256,
        }
    }
}

impl Unix {
    /// Where the socket is: at the configured path, else at the first of [`Unix::places`].
    pub fn path(&self) -> PathBuf {
        let configured = self.path.clone();
        configured.unwrap_or_else(|| Self::places().swap_remove(0))
    }

    /// Where a socket is by default: in the service's runtime directory, else in the user's, else in
    /// `/run/hardnessd`. Those that apply here, the first one first.
    pub fn places() -> Vec<PathBuf> {
        let named = |variable| env::var(variable).ok().filter(|value| !value.is_empty());
        // systemd separates several by colons.
        let service = named("RUNTIME_DIRECTORY").map(|directories| {
            let first = directories.split(':').next().unwrap_or_default();
            PathBuf::from(first)
        });
        let user =
            named("XDG_RUNTIME_DIR").map(|directory| Path::new(&directory).join("hardnessd"));
        let directories = service.into_iter().chain(user);
        directories
            .chain([PathBuf::from("/run/hardnessd")])
            .map(|directory| directory.join("events.sock"))
            .collect()
    }

    /// Where the control socket is.
    pub fn control_path(&self) -> PathBuf {
        let beside = || self.path().with_file_name("control.sock");
        self.control_path.clone().unwrap_or_else(beside)
    }

    /// The same, at `path`.
    #[must_use]
    pub fn at(self, path: PathBuf) -> Self {
        Self {
            path: Some(path),
            ..self
        }
    }
}

/// Permissions of a file, written in octal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Mode(pub u32);

/// Text that is no [`Mode`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("found {0:?}, expected octal permissions such as \"0660\"")]
pub struct ModeError(String);

impl TryFrom<String> for Mode {
    type Error = ModeError;

    fn try_from(text: String) -> Result<Self, ModeError> {
        match u32::from_str_radix(&text, 8) {
            Ok(mode) if mode <= 0o777 => Ok(Self(mode)),
            _ => Err(ModeError(text)),
        }
    }
}

impl From<Mode> for String {
    fn from(mode: Mode) -> Self {
        format!("{:04o}", mode.0)
    }
}
