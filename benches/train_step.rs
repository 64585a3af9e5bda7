//! Seconds of a training step: `cargo bench --features train --bench train_step`.
//!
//! On its own it prints the median step of each network. With `--serve` it obeys a peer line by
//! line, so that `benches/pytorch_step.py` can run its own steps in turn with these on the same
//! machine in the same minute, from the same weights and images: only their ratio says anything.
//! Seconds are those of the processor, so that a busy machine does not count.

use std::io::{BufRead as _, Write as _};
use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use hardnessd::random::Stream;
use hardnessd::train::hrn;
use hardnessd::train::network::{Normalisation, Weights, numbers};
use hardnessd::train::optimiser::{self, Optimiser};
use ndarray::{ArrayD, IxDyn};
use ndarray_npy::NpzWriter;
use rustix::time::{ClockId, clock_gettime};

/// As in `hrn-train`.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Of the paper: a batch of 100, four levels, plain SGD at 1e-3.
const BATCH: usize = 100;
const LEVELS: usize = 4;
const RATE: f64 = 1e-3;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    if let Some(place) = arguments.iter().position(|argument| argument == "--serve") {
        serve(Path::new(&arguments[place + 1]));
        return;
    }
    let mut hrn = HrnStep::new();
    hrn.run(10);
    let mut seconds: Vec<f64> = (0..50).map(|_| hrn.run(1).0).collect();
    seconds.sort_by(f64::total_cmp);
    println!("hrn step of {BATCH}: median {:.2} ms", seconds[25] * 1e3);
}

/// Of all threads of this process.
fn processor_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// Writes images, targets and initial weights to `file`, then answers `NETWORK STEPS` with
/// `seconds loss loss ...`.
fn serve(file: &Path) {
    let mut hrn = HrnStep::new();
    hrn.write(file);
    println!("ready");
    for line in std::io::stdin().lock().lines() {
        let line = line.expect("the peer sends text");
        let steps = match line.split_once(' ') {
            Some(("hrn", steps)) => steps.parse().expect("a number of steps"),
            _ => panic!("{line}: expected `hrn STEPS`"),
        };
        let (seconds, losses) = hrn.run(steps);
        let losses: Vec<String> = losses.iter().map(f32::to_string).collect();
        println!("{seconds} {}", losses.join(" "));
        std::io::stdout().flush().expect("the peer reads");
    }
}

/// The supervised step: forward, backward, update.
struct HrnStep {
    weights: Weights,
    optimiser: Optimiser,
    images: Tensor<4>,
    targets: Tensor<2>,
}

impl HrnStep {
    fn new() -> Self {
        let device = Device::flex();
        let mut stream = Stream::new(1, "bench images");
        // Like pressed frames: most of it background.
        let pixel = |_| (stream.normal().max(0.0) * 0.5 - 1.0).min(1.0) as f32;
        let images: Vec<f32> = (0..BATCH * 28 * 28).map(pixel).collect();
        let images = Tensor::from_data(TensorData::new(images, [BATCH, 1, 28, 28]), &device);
        let levels_of = (0..BATCH).map(|n| (n % LEVELS) as u8 + 1);
        let weights = hrn::initial(LEVELS, 1, &device);
        let settings = optimiser::Settings::default();
        Self {
            optimiser: Optimiser::new(settings, &weights),
            weights,
            images,
            targets: hrn::targets(levels_of, LEVELS, &device),
        }
    }

    fn run(&mut self, steps: usize) -> (f64, Vec<f32>) {
        let begun = processor_seconds();
        let losses = (0..steps).map(|_| self.step()).collect();
        (processor_seconds() - begun, losses)
    }

    fn step(&mut self) -> f32 {
        let tracked = self.weights.tracked();
        let logits = hrn::logits(&tracked, self.images.clone(), &mut Normalisation::Batch);
        let loss = hrn::cross_entropy(logits, self.targets.clone());
        let mut gradients = loss.backward();
        self.optimiser
            .step(&mut self.weights, &tracked, &mut gradients, RATE);
        numbers(&loss)[0]
    }

    fn write(&self, path: &Path) {
        let file = std::fs::File::create(path).expect("a file that can be written");
        let mut npz = NpzWriter::new(file);
        let mut add = |name: &str, dims: &[usize], values: Vec<f32>| {
            let array =
                ArrayD::from_shape_vec(IxDyn(dims), values).expect("as many as the axes say");
            npz.add_array(name, &array).expect("room on the disk");
        };
        for weight in &self.weights.entries {
            add(&weight.name, &weight.dims, numbers(&weight.values));
        }
        add("images", &self.images.dims(), numbers(&self.images));
        add("targets", &self.targets.dims(), numbers(&self.targets));
        npz.finish().expect("room on the disk");
    }
}
