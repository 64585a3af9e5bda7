//! Prints the sensors of a simulated data set as JSON. Reads the `settings` of the data
//! set's `meta` on stdin.

use std::error::Error;
use std::io::{stdin, stdout};

use hardnessd_simulator::CourseSettings;

fn main() -> Result<(), Box<dyn Error>> {
    let settings: CourseSettings = serde_json::from_reader(stdin())?;
    serde_json::to_writer(stdout(), &settings.sensors())?;
    Ok(())
}
