//! Whether the service may open a port: by its user and groups, and by the unit's list of devices.

use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use glob::Pattern;

use super::{Fault, entry, field, lets_in, names, number, under};

/// Where systemd looks for units, those of the administrator first (systemd.unit(5)).
const UNITS: [&str; 4] = [
    "etc/systemd/system",
    "run/systemd/system",
    "usr/lib/systemd/system",
    "lib/systemd/system",
];

/// The faults of `device` for the service. None if the service is not installed.
pub(super) fn faults(root: &Path, device: &Path) -> Vec<Fault> {
    let Some(unit) = unit(root) else {
        return Vec::new();
    };
    let shown = device.display();
    let refused = of_user(root, device, &unit).into_iter().map(|(user, group)| Fault {
        what: format!("the service's user {user} may not open it (group {group})"),
        cure: format!(
            "`sudo systemctl edit hardnessd`, add `[Service]` and `SupplementaryGroups={group}`, then \
             `sudo systemctl restart hardnessd`"
        ),
    });
    let forbidden = of_policy(root, device, &unit).into_iter().map(|name| Fault {
        what: format!(
            "the service may not open {shown}: \"Operation not permitted\", because DeviceAllow= of \
             hardnessd.service lacks char-{name}"
        ),
        cure: format!(
            "`sudo systemctl edit hardnessd`, add `[Service]` and `DeviceAllow=char-{name} rw`, then \
             `sudo systemctl restart hardnessd`"
        ),
    });
    refused.chain(forbidden).collect()
}

/// Whether the service may reach no other machine.
pub(super) fn forbids_network(root: &Path) -> bool {
    unit(root).is_some_and(|unit| {
        let allowed = values(&unit, "IPAddressAllow");
        values(&unit, "IPAddressDeny").contains(&"any")
            && allowed.iter().all(|allowed| *allowed == "localhost")
    })
}

/// The unit, and the files that change it, as one text.
fn unit(root: &Path) -> Option<String> {
    let mut places = UNITS.iter().map(|place| root.join(place));
    let mut text =
        places.find_map(|place| fs::read_to_string(place.join("hardnessd.service")).ok())?;
    for place in UNITS {
        let folder = format!("{place}/hardnessd.service.d");
        let mut changes = names(root, &folder);
        changes.sort();
        for name in changes {
            let change = fs::read_to_string(root.join(&folder).join(name));
            text = text + "\n" + &change.unwrap_or_default();
        }
    }
    Some(text)
}

/// The values of a key that may be given several times. An empty value takes back the earlier ones.
fn values<'a>(unit: &'a str, key: &str) -> Vec<&'a str> {
    let mut values = Vec::new();
    for line in unit.lines() {
        match line
            .trim()
            .strip_prefix(key)
            .and_then(|rest| rest.strip_prefix('='))
        {
            Some("") => values.clear(),
            Some(value) => values.push(value),
            None => {}
        }
    }
    values
}

/// The unit's user and the device's group, if the device's mode does not let the user in.
fn of_user(root: &Path, device: &Path, unit: &str) -> Option<(String, String)> {
    let user = *values(unit, "User").last()?;
    let passwd = fs::read_to_string(root.join("etc/passwd")).ok()?;
    let line = passwd.lines().find(|line| field(line, 0) == user)?;
    let uid: u32 = field(line, 2).parse().ok()?;
    let listed = values(unit, "SupplementaryGroups");
    let listed: Vec<&str> = listed.into_iter().flat_map(str::split_whitespace).collect();
    let groups = fs::read_to_string(root.join("etc/group")).ok()?;
    let is_member = |group: &&str| {
        listed.contains(&field(group, 0).as_str())
            || field(group, 3).split(',').any(|one| one == user)
    };
    let gid = |group: &str| field(group, 2).parse().ok();
    let mut gids: Vec<u32> = groups.lines().filter(is_member).filter_map(gid).collect();
    gids.extend(field(line, 3).parse::<u32>());
    let file = fs::metadata(under(root, device)).ok()?;
    let group =
        entry(root, "etc/group", file.gid()).map_or(file.gid().to_string(), |line| field(&line, 0));
    (!lets_in(&file, uid, &gids)).then(|| (user.to_owned(), group))
}

/// The kernel's name for the kind of `device`, if the unit's list of devices lacks it.
fn of_policy(root: &Path, device: &Path, unit: &str) -> Option<String> {
    // The rights come after the name.
    let allowed = values(unit, "DeviceAllow").into_iter();
    let allowed: Vec<&str> = allowed
        .filter_map(|value| value.split_whitespace().next())
        .collect();
    if allowed.is_empty() {
        return None;
    }
    let number = number(root, device)?;
    let (major, _) = number.split_once(':')?;
    let devices = fs::read_to_string(root.join("proc/devices")).ok()?;
    let characters = devices.split("Block devices:").next()?;
    let numbered = characters
        .lines()
        .filter_map(|line| line.trim().split_once(' '));
    let mut kinds = numbered
        .filter(|(number, _)| *number == major)
        .map(|(_, name)| name);
    let shown = device.to_string_lossy();
    let is_allowed = |kind: &str| {
        allowed
            .iter()
            .any(|allowed| match allowed.strip_prefix("char-") {
                Some(pattern) => Pattern::new(pattern).is_ok_and(|pattern| pattern.matches(kind)),
                None => *allowed == shown,
            })
    };
    // Several kinds may share a number. systemd then allows all of them.
    let first = kinds.next()?;
    let lacks = !is_allowed(first) && !kinds.any(is_allowed);
    lacks.then(|| first.to_owned())
}
