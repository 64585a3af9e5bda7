//! All publishers of the daemon, which are opened together and served together.

use std::net::SocketAddr;
use std::path::Path;

use rustix::process::Gid;
use tokio::runtime::Handle;
use tokio::task::JoinSet;
use tracing::info;

use super::Error;
use super::accept::{Stop, accept};
use super::client::{Access, Service};
use super::clients::Clients;
use super::config::{Config, Mode, Unix};
#[cfg(feature = "foxglove")]
use super::foxglove;
use super::http::Http;
use super::hub::Hub;
use super::relay::Worker;
#[cfg(feature = "ros2")]
use super::ros2;
use super::sensor::Sensors;
use super::socket::{self, Socket};
use super::tcp::Tcp;
#[cfg(feature = "zenoh")]
use super::zenoh;

/// The keys of the sockets' paths in the configuration.
const EVENTS_KEY: &str = "publish.unix.path";
const CONTROL_KEY: &str = "publish.unix.control_path";
const GROUP_KEY: &str = "publish.unix.control_group";

/// Checks that the sockets can be made where the configuration says. The check binds nothing, so it cannot
/// detect a path that another process uses.
pub(crate) fn check(unix: &Unix) -> Result<(), Error> {
    if unix.enabled {
        socket::check(EVENTS_KEY, &unix.path())?;
        socket::check(CONTROL_KEY, &unix.control_path())?;
        control_group(unix)?;
    }
    Ok(())
}

/// The group of the control socket's file, if the configuration names one.
fn control_group(unix: &Unix) -> Result<Option<Gid>, Error> {
    let Some(name) = &unix.control_group else {
        return Ok(None);
    };
    let found = socket::group(name);
    let expected = "expected a group of /etc/group, such as \"hardnessd-control\" of the package";
    found
        .map(Some)
        .ok_or_else(|| Error::Config(format!("{GROUP_KEY}: found {name:?}, {expected}")))
}

/// The publishers. Connections wait until [`Publishers::serve`] is called.
pub(crate) struct Publishers {
    max_clients: usize,
    hub: Hub,
    socket: Option<Socket>,
    control: Option<Socket>,
    tcp: Option<Tcp>,
    http: Option<Tcp>,
    /// Whether the live page may set the context of a sensor.
    sets_context: bool,
    /// The publishers whose library has a thread of its own.
    workers: Vec<Worker>,
}

impl Publishers {
    /// Opens all publishers of the configuration, or none. Call it on the sensors' thread, which
    /// serves the control socket itself. All others belong to the thread for `clients`.
    pub(crate) fn bind(config: &Config, hub: &Hub, clients: &Clients) -> Result<Self, Error> {
        let publish = &config.publish;
        let unix = &publish.unix;
        let socket = |key, path: &Path, mode: Mode, group| {
            let made = unix.enabled.then(|| Socket::bind(key, path, mode.0, group));
            made.transpose()
        };
        let on_their_thread = clients.runtime.enter();
        let events = socket(EVENTS_KEY, &unix.path(), unix.mode, None)?;
        drop(on_their_thread);
        let group = control_group(unix)?;
        let control = socket(CONTROL_KEY, &unix.control_path(), unix.control_mode, group)?;
        let _on_their_thread = clients.runtime.enter();
        let tcp = publish.tcp.as_ref();
        let tcp = tcp.map(|tcp| Tcp::bind("publish.tcp.listen", tcp.listen));
        let http = config.http.as_ref();
        let sets_context = http.is_some_and(|http| http.set_context);
        let http = http.map(|http| Tcp::bind("http.listen", http.listen));
        #[allow(unused_mut, reason = "a feature may fill it")]
        let mut opened = Self {
            max_clients: unix.max_clients,
            hub: hub.clone(),
            socket: events,
            control,
            tcp: tcp.transpose()?,
            http: http.transpose()?,
            sets_context,
            workers: Vec::new(),
        };
        #[cfg(feature = "foxglove")]
        if let Some(settings) = &publish.foxglove {
            opened.workers.push(foxglove::open(settings, config)?);
        }
        #[cfg(feature = "ros2")]
        if let Some(settings) = &publish.ros2 {
            opened.workers.push(ros2::open(settings, config, hub)?);
        }
        #[cfg(feature = "zenoh")]
        if let Some(settings) = &publish.zenoh {
            opened.workers.push(zenoh::open(settings, config, hub)?);
        }
        Ok(opened)
    }

    /// The address of the live page.
    pub(crate) fn http_address(&self) -> Option<SocketAddr> {
        self.http.as_ref().map(Tcp::address)
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
    pub(crate) fn serve(self, sensors: &Sensors, stop: &Stop, clients: &Clients) -> JoinSet<()> {
        let Self {
            max_clients,
            hub,
            socket,
            control,
            tcp,
            http,
            sets_context,
            workers,
            ..
        } = self;
        let service = |access| Service {
            access,
            max_clients,
            hub: hub.clone(),
            sensors: sensors.clone(),
            writers: Handle::current(),
        };
        let on = &clients.runtime;
        let mut tasks = JoinSet::new();
        if let Some(socket) = socket {
            let service = service(Access::ReadOnly);
            tasks.spawn_on(accept(socket, max_clients, service, stop.clone()), on);
        }
        if let Some(control) = control {
            let service = service(Access::Control);
            tasks.spawn(accept(control, max_clients, service, stop.clone()));
        }
        if let Some(tcp) = tcp {
            let service = service(Access::ReadOnly);
            tasks.spawn_on(accept(tcp, max_clients, service, stop.clone()), on);
        }
        if let Some(listener) = http {
            let setter = sets_context.then(|| sensors.clone());
            let http = Http::new(listener.address(), hub.clone(), setter, stop.clone());
            tasks.spawn_on(
                accept(listener, Http::MOST_CONNECTIONS, http, stop.clone()),
                on,
            );
        }
        for worker in workers {
            tasks.spawn_on(worker.serve(hub.clone(), sensors.clone()), on);
        }
        tasks
    }
}
