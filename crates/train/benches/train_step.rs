//! Seconds of a training step: `cargo bench -p hrn-train --bench train_step`.
//!
//! Alone, it prints the median step of each network. With `--serve` it obeys a peer line by line.
//! So `benches/pytorch_step.py` can run its own steps in turn with these, on the same machine in
//! the same minute, from the same weights and images. Only their ratio has a meaning. The seconds
//! are processor time, so that a busy machine makes no difference.

use std::collections::BTreeMap;
use std::io::{BufRead as _, Write as _};
use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use hardnessd_core::npz::Writer;
use hardnessd_simulator::random::Stream;
use hrn_train::learn::learner::Learner;
use hrn_train::learn::{gan, hrn as learn_hrn};
use hrn_train::net::losses::Game;
use hrn_train::net::network::{Weights, numbers, targets};
use hrn_train::net::{generator, hrn};
use hrn_train::settings::Training;
use rustix::time::{ClockId, clock_gettime};

/// The same allocator as in `hrn-train`.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// The paper's values: a batch of 100, four levels, a learning rate of 1e-3.
const BATCH: usize = 100;
const LEVELS: usize = 4;
const RATE: f64 = 1e-3;
/// The game of USTGAN.
const GAME: Game = Game::RealOrFake;

fn main() {
    // Like hrn-train, take the steps on a thread of the pool.
    rayon::scope(|_| run());
}

fn run() {
    let arguments: Vec<String> = std::env::args().collect();
    let inputs = Inputs::new();
    if let Some(place) = arguments.iter().position(|argument| argument == "--serve") {
        serve(&inputs, Path::new(&arguments[place + 1]));
        return;
    }
    for name in ["hrn", "gan"] {
        let mut network = inputs.network(name);
        blocks(&mut network, 10);
        let mut seconds: Vec<f64> = (0..50).map(|_| blocks(&mut network, 1).0).collect();
        seconds.sort_by(f64::total_cmp);
        println!("{name} step of {BATCH}: median {:.2} ms", seconds[25] * 1e3);
    }
}

/// Writes images, targets, noise and initial weights to `file`, then answers `NETWORK STEPS` with
/// `seconds loss loss ...`.
fn serve(inputs: &Inputs, file: &Path) {
    inputs.write(file);
    let mut networks = BTreeMap::<String, Network>::new();
    println!("ready");
    for line in std::io::stdin().lock().lines() {
        let line = line.expect("the peer sends text");
        let (name, steps) = line.split_once(' ').expect("NETWORK STEPS");
        let network = networks.entry(name.to_owned());
        let network = network.or_insert_with(|| inputs.network(name));
        let (seconds, losses) = blocks(network, steps.parse().expect("a number of steps"));
        let losses: Vec<String> = losses.iter().map(f64::to_string).collect();
        println!("{seconds} {}", losses.join(" "));
        std::io::stdout().flush().expect("the peer reads");
    }
}

/// Takes a step and gives its loss. The loss of a GAN is the sum of both sides'.
type Network = Box<dyn FnMut() -> f64>;

/// The seconds and the losses of `steps` steps.
fn blocks(network: &mut Network, steps: usize) -> (f64, Vec<f64>) {
    let begun = processor_seconds();
    let losses = (0..steps).map(|_| network()).collect();
    (processor_seconds() - begun, losses)
}

/// What the networks start from, and the inputs of their steps, which are always the same.
struct Inputs {
    hrn: Weights,
    /// The generator and the discriminator.
    gan: [Weights; 2],
    targets: Tensor<2>,
    /// The inputs of a step of USTGAN. HRN takes its images, too.
    batch: gan::Batch,
}

impl Inputs {
    fn new() -> Self {
        let device = Device::flex();
        let mut stream = Stream::new(1, "bench images");
        // Like pressed frames, the images are mostly background.
        let pixel = |_| (stream.normal().max(0.0) * 0.5 - 1.0).min(1.0) as f32;
        let images: Vec<f32> = (0..BATCH * 28 * 28).map(pixel).collect();
        let levels_of = (0..BATCH).map(|n| (n % LEVELS) as u8 + 1);
        Self {
            hrn: hrn::initial(None, LEVELS, false, 1, &device),
            gan: gan::initial(GAME, LEVELS, 1, &device),
            targets: targets(levels_of, LEVELS, &device),
            batch: gan::Batch {
                real: Tensor::from_data(TensorData::new(images, [BATCH, 1, 28, 28]), &device),
                labelled: None,
                eta: generator::noise(generator::SAMPLES_A_COMPONENT, &mut stream, &device),
                sensing: None,
            },
        }
    }

    /// The supervised HRN, or both sides of USTGAN, also with plain SGD: if a gradient is nothing but rounding,
    /// Adam still makes a step of the full rate, so with Adam two exact computations differ after three steps.
    fn network(&self, name: &str) -> Network {
        let (batch, targets) = (self.batch.clone(), self.targets.clone());
        let training = match name {
            "hrn" => {
                let mut hrn = Learner::fresh(self.hrn.clone(), Training::default());
                return Box::new(move || {
                    learn_hrn::step(&mut hrn, batch.real.clone(), targets.clone(), RATE).0
                });
            }
            "gan" => Training::of_a_gan(),
            "gan-sgd" => Training::default(),
            _ => panic!("{name}: expected hrn, gan or gan-sgd"),
        };
        let mut sides = self.gan.clone().map(|side| Learner::fresh(side, training));
        Box::new(move || gan::step(&mut sides, GAME, &batch, RATE).iter().sum())
    }

    fn write(&self, path: &Path) {
        let file = std::fs::File::create(path).expect("a file that can be written");
        let mut npz = Writer::new(file);
        let mut add = |name: &str, dims: &[usize], values: Vec<f32>| {
            npz.add(name, dims, &values).expect("room on the disk");
        };
        let [generator, discriminator] = &self.gan;
        for (side, weights) in [
            ("hrn", &self.hrn),
            ("generator", generator),
            ("discriminator", discriminator),
        ] {
            for weight in &weights.entries {
                let name = format!("{side}/{}", weight.name);
                add(&name, &weight.dims, numbers(&weight.values));
            }
        }
        let (images, eta) = (&self.batch.real, &self.batch.eta);
        add("images", &images.dims(), numbers(images));
        add("targets", &self.targets.dims(), numbers(&self.targets));
        add("eta", &eta.dims(), numbers(eta));
        npz.finish().expect("room on the disk");
    }
}

/// The processor time of all threads of this process.
fn processor_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}
