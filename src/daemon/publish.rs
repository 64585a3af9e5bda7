//! All publishers of the daemon, which are opened together and served together.

use std::net::SocketAddr;
use std::pin::Pin;

use rustix::process::Gid;
use tokio::runtime::Handle;
use tokio::task::JoinSet;
use tracing::info;

use super::Error;
use super::accept::{Stop, accept};
use super::client::Service;
use super::config::{Config, Unix};
#[cfg(feature = "foxglove")]
use super::foxglove;
use super::http::Http;
use super::hub::Hub;
#[cfg(feature = "zenoh")]
use super::rmw_zenoh;
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
    let expected = "expected a group of /etc/group; the package makes \"hardnessd-control\"";
    found
        .map(Some)
        .ok_or_else(|| Error::config(format!("{GROUP_KEY}: found {name:?}, {expected}")))
}

/// What serves a publisher until the order to stop.
type Serving = Pin<Box<dyn Future<Output = ()> + Send>>;

/// The running publishers.
pub(super) struct Publishers {
    /// A task for each. It ends after the order to stop, when its subscribers have their last lines.
    pub(super) tasks: JoinSet<()>,
    /// The address of the live page.
    pub(super) http: Option<SocketAddr>,
}

impl Publishers {
    /// Opens all publishers of the configuration, or none. Call it on the sensors' thread, which serves the
    /// control socket itself. All others belong to the thread of `clients`.
    pub(super) fn start(
        config: &Config,
        hub: &Hub,
        sensors: &Sensors,
        clients: &Handle,
        stop: &Stop,
    ) -> Result<Self, Error> {
        let (publish, unix) = (&config.publish, &config.publish.unix);
        let (most, ours) = (unix.max_clients, Handle::current());
        let service = |control| Service {
            max_clients: most,
            hub: hub.clone(),
            control,
        };
        // None of them is served before all are open.
        let mut serving: Vec<(&Handle, Serving)> = Vec::new();
        let (mut paths, mut addresses) = (Vec::new(), Vec::new());
        if unix.enabled {
            let (path, control_path) = (unix.path(), unix.control_path());
            let on_their_thread = clients.enter();
            let events = Socket::bind(EVENTS_KEY, &path, unix.mode.0, None)?;
            drop(on_their_thread);
            let (mode, group) = (unix.control_mode.0, control_group(unix)?);
            let control = Socket::bind(CONTROL_KEY, &control_path, mode, group)?;
            let events = accept(events, most, service(None), stop.clone());
            let control = accept(control, most, service(Some(sensors.clone())), stop.clone());
            serving.push((clients, Box::pin(events)));
            serving.push((&ours, Box::pin(control)));
            paths.extend([("events", path), ("control", control_path)]);
        }
        let _on_their_thread = clients.enter();
        if let Some(settings) = &publish.tcp {
            let tcp = Tcp::bind("publish.tcp.listen", settings.listen)?;
            addresses.push(("tcp", tcp.address));
            let tcp = accept(tcp, most, service(None), stop.clone());
            serving.push((clients, Box::pin(tcp)));
        }
        let mut http = None;
        if let Some(settings) = &config.http {
            let tcp = Tcp::bind("http.listen", settings.listen)?;
            let address = *http.insert(tcp.address);
            addresses.push(("http", address));
            let setter = settings.set_context.then(|| sensors.clone());
            let service = Http::new(address, hub.clone(), setter, stop.clone());
            let page = accept(tcp, Http::MOST_CONNECTIONS, service, stop.clone());
            serving.push((clients, Box::pin(page)));
        }
        #[cfg(feature = "foxglove")]
        if let Some(settings) = &publish.foxglove {
            let worker = foxglove::open(settings, config)?;
            serving.push((clients, Box::pin(worker.serve(hub.clone()))));
        }
        #[cfg(feature = "ros2")]
        if let Some(settings) = &publish.ros2 {
            let worker = ros2::open(settings, sensors)?;
            serving.push((clients, Box::pin(worker.serve(hub.clone()))));
        }
        #[cfg(feature = "zenoh")]
        if let Some(settings) = &publish.zenoh {
            let worker = zenoh::open(settings, config, hub)?;
            serving.push((clients, Box::pin(worker.serve(hub.clone()))));
        }
        #[cfg(feature = "zenoh")]
        if let Some(settings) = &publish.rmw_zenoh {
            let worker = rmw_zenoh::open(settings, sensors)?;
            serving.push((clients, Box::pin(worker.serve(hub.clone()))));
        }
        for (way, path) in paths {
            info!(way, path = %path.display(), "listening");
        }
        for (way, address) in addresses {
            info!(way, %address, "listening");
        }
        let mut tasks = JoinSet::new();
        for (thread, serving) in serving {
            tasks.spawn_on(serving, thread);
        }
        Ok(Self { tasks, http })
    }
}
