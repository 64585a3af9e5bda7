//! Seconds of a training step: `cargo bench -p hrn-train --bench train_step`.
//!
//! Alone, it prints the median step of each network. With `--serve` it obeys a peer line by line.
//! So `benches/pytorch_step.py` can run its own steps in turn with these, on the same machine in
//! the same minute, from the same weights and images. Only their ratio has a meaning. The seconds
//! are processor time, so that a busy machine makes no difference.

use std::io::{BufRead as _, Write as _};
use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use hardnessd_core::npz::Writer;
use hardnessd_simulator::random::Stream;
use hrn_train::learn::learner::Learner;
use hrn_train::learn::{gan, hrn as learn_hrn};
use hrn_train::net::losses::Game;
use hrn_train::net::network::numbers;
use hrn_train::net::{generator, hrn};
use hrn_train::settings::network::Pooling;
use hrn_train::settings::{GanSettings, OptimiserSettings};
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
    if let Some(place) = arguments.iter().position(|argument| argument == "--serve") {
        serve(Path::new(&arguments[place + 1]));
        return;
    }
    let mut networks = Networks::new();
    for name in ["hrn", "gan"] {
        networks.run(name, 10);
        let mut seconds: Vec<f64> = (0..50).map(|_| networks.run(name, 1).0).collect();
        seconds.sort_by(f64::total_cmp);
        println!("{name} step of {BATCH}: median {:.2} ms", seconds[25] * 1e3);
    }
}

/// Writes images, targets, noise and initial weights to `file`, then answers `NETWORK STEPS` with
/// `seconds loss loss ...`.
fn serve(file: &Path) {
    let mut networks = Networks::new();
    networks.write(file);
    println!("ready");
    for line in std::io::stdin().lock().lines() {
        let line = line.expect("the peer sends text");
        let (name, steps) = line.split_once(' ').expect("NETWORK STEPS");
        let (seconds, losses) = networks.run(name, steps.parse().expect("a number of steps"));
        let losses: Vec<String> = losses.iter().map(f64::to_string).collect();
        println!("{seconds} {}", losses.join(" "));
        std::io::stdout().flush().expect("the peer reads");
    }
}

/// The networks: the supervised HRN, and both sides of USTGAN. Their inputs are always the same.
struct Networks {
    hrn: Learner,
    /// The generator and the discriminator.
    gan: [Learner; 2],
    /// The same two with plain SGD. If a gradient is nothing but rounding, Adam still makes a step
    /// of the full rate. So with Adam, two exact computations differ after three steps.
    gan_sgd: [Learner; 2],
    images: Tensor<4>,
    targets: Tensor<2>,
    eta: Tensor<2>,
}

impl Networks {
    fn new() -> Self {
        let device = Device::flex();
        let mut stream = Stream::new(1, "bench images");
        // Like pressed frames, the images are mostly background.
        let pixel = |_| (stream.normal().max(0.0) * 0.5 - 1.0).min(1.0) as f32;
        let images: Vec<f32> = (0..BATCH * 28 * 28).map(pixel).collect();
        let images = Tensor::from_data(TensorData::new(images, [BATCH, 1, 28, 28]), &device);
        let levels_of = (0..BATCH).map(|n| (n % LEVELS) as u8 + 1);
        let adversaries = GanSettings::default();
        let gan = gan::initial(GAME, LEVELS, 1, &device);
        let sgd = OptimiserSettings::default();
        let sides = |settings| {
            gan.clone()
                .map(|weights| Learner::fresh(weights, settings, 0.0))
        };
        Self {
            hrn: Learner::fresh(hrn::initial(LEVELS, Pooling::Max, 1, &device), sgd, 0.0),
            gan: sides(adversaries.optimiser),
            gan_sgd: sides(sgd),
            images,
            targets: hrn::targets(levels_of, LEVELS, &device),
            eta: generator::noise(BATCH / generator::COMPONENTS, &mut stream, &device),
        }
    }

    /// The seconds and the losses of `steps` steps. The losses of a GAN are the sum of both sides'.
    fn run(&mut self, name: &str, steps: usize) -> (f64, Vec<f64>) {
        let begun = processor_seconds();
        let step = |_| match name {
            "hrn" => {
                let (images, targets) = (self.images.clone(), self.targets.clone());
                learn_hrn::step(&mut self.hrn, images, targets, RATE).0
            }
            "gan" => gan_step(&mut self.gan, &self.images, &self.eta),
            "gan-sgd" => gan_step(&mut self.gan_sgd, &self.images, &self.eta),
            _ => panic!("{name}: expected hrn, gan or gan-sgd"),
        };
        let losses = (0..steps).map(step).collect();
        (processor_seconds() - begun, losses)
    }

    fn write(&self, path: &Path) {
        let file = std::fs::File::create(path).expect("a file that can be written");
        let mut npz = Writer::plain(file);
        let mut add = |name: &str, dims: &[usize], values: Vec<f32>| {
            npz.add(name, dims, &values).expect("room on the disk");
        };
        let sides = [
            ("hrn", &self.hrn),
            ("generator", &self.gan[0]),
            ("discriminator", &self.gan[1]),
        ];
        for (side, learner) in sides {
            for weight in &learner.weights.entries {
                let name = format!("{side}/{}", weight.name);
                add(&name, &weight.dims, numbers(&weight.values));
            }
        }
        add("images", &self.images.dims(), numbers(&self.images));
        add("targets", &self.targets.dims(), numbers(&self.targets));
        add("eta", &self.eta.dims(), numbers(&self.eta));
        npz.finish().expect("room on the disk");
    }
}

/// The processor time of all threads of this process.
fn processor_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// The sum of both sides' losses.
fn gan_step(gan: &mut [Learner; 2], images: &Tensor<4>, eta: &Tensor<2>) -> f64 {
    let batch = gan::Images {
        real: images.clone(),
        labelled: None,
    };
    let rules = gan::Rules {
        game: GAME,
        sigma_penalty: GanSettings::default().sigma_penalty,
        rate: RATE,
        sensing: None,
    };
    let [generator, discriminator] = gan;
    let losses = gan::step(generator, discriminator, &batch, eta.clone(), &rules);
    losses.0 + losses.1
}
