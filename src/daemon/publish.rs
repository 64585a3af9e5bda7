//! All publishers of the daemon, which are opened together and served together.

use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tracing::info;

use super::accept::{Stop, accept};
use super::client::{Access, Service};
use super::clients::Clients;
use super::config::{Config, Unix};
#[cfg(feature = "foxglove")]
use super::foxglove;
use super::http::Http;
use super::hub;
#[cfg(feature = "foxglove")]
use super::hub::Line;
#[cfg(any(feature = "foxglove", feature = "ros2", feature = "zenoh"))]
use super::relay::Worker;
#[cfg(feature = "ros2")]
use super::ros2;
use super::sensor::Sensors;
use super::snapshot::Snapshots;
use super::socket::{self, Problem, Socket};
use super::systemd;
use super::tcp::{self, Tcp};
#[cfg(feature = "zenoh")]
use super::zenoh;
use hardnessd_core::exit::{CONFIG, Coded, IO};
use hardnessd_core::recording::Found;

/// The mode of the control socket's file: only the daemon's own user may connect.
const CONTROL_MODE: u32 = 0o600;

/// The keys of the sockets' paths in the configuration.
const EVENTS_KEY: &str = "publish.unix.path";
const CONTROL_KEY: &str = "publish.unix.control_path";

/// Checks that the sockets can be made, without making them.
pub(crate) fn check(unix: &Unix) -> Result<(), Error> {
    if unix.enabled {
        socket::check(EVENTS_KEY, &unix.path())?;
        socket::check(CONTROL_KEY, &unix.control_path())?;
    }
    Ok(())
}

/// The reason a publisher could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The error of a Unix socket.
    #[error(transparent)]
    Socket(#[from] socket::Error),
    /// The error of a TCP listener.
    #[error(transparent)]
    Tcp(#[from] tcp::Error),
    /// The error of the server for Foxglove.
    #[cfg(feature = "foxglove")]
    #[error(transparent)]
    Foxglove(#[from] foxglove::Error),
    /// The error of the ROS 2 node.
    #[cfg(feature = "ros2")]
    #[error(transparent)]
    Ros2(#[from] ros2::Error),
    /// The error of the zenoh session.
    #[cfg(feature = "zenoh")]
    #[error(transparent)]
    Zenoh(#[from] zenoh::Error),
    /// The service manager listens at a path that the configuration does not name.
    #[error(
        "socket activation: the service manager listens at {found}, which the configuration does \
         not name: set publish.unix.path or control_path to it"
    )]
    Unasked {
        /// The path that the service manager listens at.
        found: PathBuf,
    },
    /// The service manager passed something other than Unix sockets.
    #[error("socket activation: {0}")]
    Passed(#[source] io::Error),
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            // The configuration names a path that the daemon cannot use.
            Error::Socket(socket::Error {
                problem: Problem::NoSocket | Problem::NoDirectory | Problem::TooLong,
                ..
            })
            | Error::Unasked { .. }
            | Error::Passed(_) => CONFIG,
            // The address is in use, or the system refused. A later try may succeed.
            _ => IO,
        }
    }
}

/// The publishers. Connections wait until [`Publishers::serve`] is called.
pub(crate) struct Publishers {
    max_clients: usize,
    socket: Option<Socket>,
    control: Option<Socket>,
    tcp: Option<Tcp>,
    http: Option<Tcp>,
    #[cfg(feature = "foxglove")]
    foxglove: Option<(Worker<Vec<Line>>, mpsc::Sender<Found>)>,
    #[cfg(feature = "ros2")]
    ros2: Option<Worker<ros2::Job>>,
    #[cfg(feature = "zenoh")]
    zenoh: Option<Worker<zenoh::Job>>,
}

impl Publishers {
    /// Opens all publishers of the configuration, or none. Call it on the sensors' thread, which
    /// serves the control socket itself. All others belong to the thread for `clients`.
    pub(crate) fn bind(config: &Config, clients: &Clients) -> Result<Self, Error> {
        let publish = &config.publish;
        let unix = &publish.unix;
        let mut passed = systemd::sockets().map_err(Error::Passed)?;
        let mut socket = |key, path: &Path, mode| {
            let made = unix.enabled.then(|| {
                let adopted = Socket::adopt(key, path, &mut passed);
                adopted.unwrap_or_else(|| Socket::bind(key, path, mode))
            });
            made.transpose()
        };
        let on_their_thread = clients.runtime.enter();
        let events = socket(EVENTS_KEY, &unix.path(), unix.mode.0)?;
        drop(on_their_thread);
        let control = socket(CONTROL_KEY, &unix.control_path(), CONTROL_MODE)?;
        let _on_their_thread = clients.runtime.enter();
        if let Some(left) = passed.first() {
            let address = left.local_addr().map_err(Error::Passed)?;
            let found = address.as_pathname().unwrap_or(Path::new("(no path)"));
            return Err(Error::Unasked {
                found: found.to_owned(),
            });
        }
        Ok(Self {
            max_clients: unix.max_clients,
            socket: events,
            control,
            tcp: publish
                .tcp
                .as_ref()
                .map(|tcp| Tcp::bind("publish.tcp.listen", tcp.listen))
                .transpose()?,
            http: config
                .http
                .as_ref()
                .map(|http| Tcp::bind("http.listen", http.listen))
                .transpose()?,
            #[cfg(feature = "foxglove")]
            foxglove: publish
                .foxglove
                .as_ref()
                .map(|settings| foxglove::open(settings, &config.robot, arrays(config)))
                .transpose()?,
            #[cfg(feature = "ros2")]
            ros2: publish
                .ros2
                .as_ref()
                .map(|settings| ros2::open(settings, &config.robot, sensors(config)))
                .transpose()?,
            #[cfg(feature = "zenoh")]
            zenoh: publish
                .zenoh
                .as_ref()
                .map(|settings| zenoh::open(settings, &config.robot, sensors(config)))
                .transpose()?,
        })
    }

    /// The address of the live page.
    pub(crate) fn http_address(&self) -> Option<SocketAddr> {
        self.http.as_ref().map(Tcp::address)
    }

    /// The queue for the positions of the arm and for new settings, if a publisher shows them.
    #[cfg(feature = "foxglove")]
    pub(crate) fn viewers(&self) -> Option<mpsc::Sender<Found>> {
        self.foxglove.as_ref().map(|(_, viewers)| viewers.clone())
    }

    /// No publisher of this build shows the positions of the arm.
    #[cfg(not(feature = "foxglove"))]
    pub(crate) fn viewers(&self) -> Option<mpsc::Sender<Found>> {
        None
    }

    /// Logs where subscribers connect.
    pub(crate) fn announce(&self) {
        for (way, socket) in [("events", &self.socket), ("control", &self.control)] {
            if let Some(socket) = socket {
                info!(way, path = %socket.path().display(), "listening");
            }
        }
        for (way, tcp) in [("tcp", &self.tcp), ("http", &self.http)] {
            if let Some(tcp) = tcp {
                info!(way, address = %tcp.address(), "listening");
            }
        }
    }

    /// Serves each publisher in a task, until the order to stop and until the publisher's
    /// subscribers have their last lines.
    pub(crate) fn serve(
        self,
        hub: &hub::Handle,
        sensors: &Sensors,
        stop: &Stop,
        clients: &Clients,
    ) -> JoinSet<()> {
        let Self {
            max_clients,
            socket,
            control,
            tcp,
            http,
            #[cfg(feature = "foxglove")]
            foxglove,
            #[cfg(feature = "ros2")]
            ros2,
            #[cfg(feature = "zenoh")]
            zenoh,
        } = self;
        let snapshots = Snapshots::new(hub.clone(), sensors.clone());
        let service = |access| Service {
            access,
            max_clients,
            hub: hub.clone(),
            sensors: sensors.clone(),
            snapshots: snapshots.clone(),
            turns: clients.turns.clone(),
            writers: Handle::current(),
        };
        let on = &clients.runtime;
        let mut tasks = JoinSet::new();
        if let Some(socket) = socket {
            let service = service(Access::ReadOnly);
            let socket = socket.obey(stop.clone());
            tasks.spawn_on(accept(socket, max_clients, service, stop.clone()), on);
        }
        if let Some(control) = control {
            let service = service(Access::Control);
            let control = control.obey(stop.clone());
            tasks.spawn(accept(control, max_clients, service, stop.clone()));
        }
        if let Some(tcp) = tcp {
            let service = service(Access::ReadOnly);
            tasks.spawn_on(accept(tcp, max_clients, service, stop.clone()), on);
        }
        if let Some(listener) = http {
            let http = Http::new(
                listener.address(),
                hub.clone(),
                sensors.clone(),
                snapshots.clone(),
                clients.turns.clone(),
                stop.clone(),
            );
            tasks.spawn_on(
                accept(listener, Http::MOST_CONNECTIONS, http, stop.clone()),
                on,
            );
        }
        #[cfg(feature = "foxglove")]
        if let Some((foxglove, _)) = foxglove {
            tasks.spawn_on(foxglove.serve(hub.clone(), sensors.clone()), on);
        }
        #[cfg(feature = "ros2")]
        if let Some(ros2) = ros2 {
            tasks.spawn_on(ros2.serve(hub.clone(), sensors.clone()), on);
        }
        #[cfg(feature = "zenoh")]
        if let Some(zenoh) = zenoh {
            tasks.spawn_on(zenoh.serve(hub.clone(), sensors.clone()), on);
        }
        tasks
    }
}

/// The names and the taxel distances of the sensors.
#[cfg(feature = "foxglove")]
fn arrays(config: &Config) -> Vec<foxglove::Sensor> {
    let sensors = config.sensors.iter();
    sensors
        .map(|sensor| foxglove::Sensor {
            name: sensor.name.clone(),
            pitch: sensor.calibration.pitch_mm,
        })
        .collect()
}

#[cfg(any(feature = "ros2", feature = "zenoh"))]
fn sensors(config: &Config) -> Vec<String> {
    let sensors = config.sensors.iter();
    sensors.map(|sensor| sensor.name.clone()).collect()
}
