//! The losses of discriminator and generator in each of the three games, from logits.
//!
//! In: a discriminator's outputs for batches of real, generated and, where there are levels,
//! labelled frames. Out: a loss of one number. The losses are written with `sp`, the softplus, and
//! `LSE`, the logarithm of the sum of exponentials, so nothing here overflows or takes the
//! logarithm of 0.

use burn::tensor::{Tensor, activation};

/// The task of the discriminator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Game {
    /// Real or generated, by one logit: DeLiGAN, and so USTGAN and STGAN.
    RealOrFake,
    /// L levels and one more for generated frames: SGAN (Odena 2016).
    FakeLevel,
    /// L levels; a generated frame's logit is fixed at 0. The generator matches mean features: IGAN
    /// (Salimans 2016).
    FeatureMatching,
}

impl Game {
    /// The number of the discriminator's logits.
    pub fn outputs(self, levels: usize) -> usize {
        match self {
            Self::RealOrFake => 1,
            Self::FakeLevel => levels + 1,
            Self::FeatureMatching => levels,
        }
    }
}

/// A discriminator's outputs for a batch.
#[derive(Debug, Clone)]
pub struct Judged {
    /// The features `[batch, 64]` after the trunk.
    pub features: Tensor<2>,
    /// The logits `[batch, outputs]`.
    pub logits: Tensor<2>,
}

/// `log(1 + exp(x))`, exact at both ends.
fn softplus<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    activation::log_sigmoid(x.neg()).neg()
}

/// Logarithm of the sum of exponentials of each row: `[batch, columns]` to `[batch, 1]`.
fn log_sum_exp(x: Tensor<2>) -> Tensor<2> {
    // The largest is subtracted before and added after, so its gradient cancels.
    let top = x.clone().detach().max_dim(1);
    x.sub(top.clone()).exp().sum_dim(1).log().add(top)
}

/// The first `columns` logits, which are those of the levels.
fn first(logits: Tensor<2>, columns: usize) -> Tensor<2> {
    let [batch, _] = logits.dims();
    logits.slice([0..batch, 0..columns])
}

/// -log(1 - p(generated)) of each row, where the last logit is that of generated frames.
fn not_generated(logits: Tensor<2>) -> Tensor<2> {
    let levels = logits.dims()[1] - 1;
    log_sum_exp(logits.clone()).sub(log_sum_exp(first(logits, levels)))
}

/// The discriminator's loss on a batch of real frames and one of generated frames; where there
/// are levels, also on logits of labelled frames with their targets `[batch, L]`.
pub fn discriminator(
    game: Game,
    real: Judged,
    generated: Judged,
    labelled: Option<(Tensor<2>, Tensor<2>)>,
) -> Tensor<1> {
    let (real, generated) = (real.logits, generated.logits);
    let loss = match game {
        // Eqs. (3), (5): L_D = -E log D(x) - E log(1 - D(G(z))). The paper prints +log D(G(z)) for
        // the second term, which has no lower bound. Eq. (8) is this loss again, of features. Below
        // Eq. (8) the paper calls beta^G the discriminator's parameters and beta^D the generator's.
        Game::RealOrFake => softplus(real.neg()).mean().add(softplus(generated).mean()),
        // A real frame is not generated. A generated frame is of the last level.
        Game::FakeLevel => {
            let [batch, outputs] = generated.dims();
            let last = generated.clone().slice([0..batch, outputs - 1..outputs]);
            let last = last.sub(log_sum_exp(generated));
            not_generated(real).mean().sub(last.mean())
        }
        // p(real) = sigmoid(LSE(l)), so -log p(real) = sp(LSE) - LSE and -log p(fake) = sp(LSE).
        Game::FeatureMatching => {
            let (real, generated) = (log_sum_exp(real), log_sum_exp(generated));
            let real = softplus(real.clone()).sub(real).mean();
            real.add(softplus(generated).mean()).mul_scalar(0.5)
        }
    };
    match labelled {
        None => loss,
        // Eq. (9) over all logits, because a labelled frame is not a generated one either.
        Some((logits, targets)) => {
            let levels = first(logits.clone(), targets.dims()[1]);
            let of_level = levels.mul(targets).sum_dim(1);
            loss.add(log_sum_exp(logits).sub(of_level).mean())
        }
    }
}

/// The generator's loss on a batch of generated frames, without [`sigma_penalty`]. Only feature
/// matching needs the `real` batch.
pub fn generator(game: Game, real: impl FnOnce() -> Judged, generated: Judged) -> Tensor<1> {
    match game {
        // Eqs. (4), (6): max E log D(G(z)), so L_G = -E log D(G(z)).
        Game::RealOrFake => softplus(generated.logits.neg()).mean(),
        Game::FakeLevel => not_generated(generated.logits).mean(),
        Game::FeatureMatching => {
            let mean = |judged: Judged| judged.features.mean_dim(0);
            let difference = mean(generated).sub(mean(real()));
            difference.clone().mul(difference).mean()
        }
    }
}

/// Eq. (7)'s penalty `(1 - sigma)^2`, which keeps the components from collapsing, as a mean over
/// all of sigma: the paper leaves the reduction open, and a sum would be 1,500 times stronger.
pub fn sigma_penalty(sigma: Tensor<2>) -> Tensor<1> {
    let distance = sigma.neg().add_scalar(1.0);
    distance.clone().mul(distance).mean()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::network::numbers;
    use burn::tensor::Device;

    fn rows<const C: usize>(rows: &[[f32; C]]) -> Tensor<2> {
        let flat: Vec<f32> = rows.iter().flatten().copied().collect();
        Tensor::<1>::from_floats(flat.as_slice(), &Device::flex()).reshape([rows.len(), C])
    }

    fn judged<const C: usize>(logits: &[[f32; C]]) -> Judged {
        Judged {
            features: rows(logits),
            logits: rows(logits),
        }
    }

    fn number(loss: &Tensor<1>) -> f64 {
        f64::from(numbers(loss)[0])
    }

    #[track_caller]
    fn check(loss: &Tensor<1>, expected: f64) {
        let found = number(loss);
        assert!((found - expected).abs() < 1e-5, "{found} {expected}");
    }

    fn sigmoid(x: f64) -> f64 {
        1.0 / (1.0 + (-x).exp())
    }

    /// Probabilities of a row of logits.
    fn softmax(row: &[f64]) -> Vec<f64> {
        let sum: f64 = row.iter().map(|x| x.exp()).sum();
        row.iter().map(|x| x.exp() / sum).collect()
    }

    #[test]
    fn real_or_fake_is_the_binary_cross_entropy() {
        let (real, fake) = (judged(&[[0.3], [-1.2]]), judged(&[[0.7], [2.0]]));
        let expected = -f64::midpoint(sigmoid(0.3).ln(), sigmoid(-1.2).ln())
            - f64::midpoint((1.0 - sigmoid(0.7)).ln(), (1.0 - sigmoid(2.0)).ln());
        let loss = discriminator(Game::RealOrFake, real.clone(), fake.clone(), None);
        check(&loss, expected);
        let expected = -f64::midpoint(sigmoid(0.7).ln(), sigmoid(2.0).ln());
        check(&generator(Game::RealOrFake, || real, fake), expected);
    }

    #[test]
    fn the_further_level_is_that_of_generated_frames() {
        let (real, fake) = (judged(&[[0.1, -0.4, 0.9]]), judged(&[[1.1, 0.2, -0.3]]));
        let labelled = (rows(&[[0.5, 0.6, 0.7]]), rows(&[[0.0, 1.0]]));
        let p_fake = softmax(&[1.1, 0.2, -0.3])[2];
        let expected = -(1.0 - softmax(&[0.1, -0.4, 0.9])[2]).ln()
            - p_fake.ln()
            - softmax(&[0.5, 0.6, 0.7])[1].ln();
        let loss = discriminator(Game::FakeLevel, real.clone(), fake.clone(), Some(labelled));
        check(&loss, expected);
        let loss = generator(Game::FakeLevel, || real, fake);
        check(&loss, -(1.0 - p_fake).ln());
    }

    #[test]
    fn feature_matching_has_an_implicit_logit_of_0() {
        let (real, fake) = (judged(&[[0.1, -0.4]]), judged(&[[1.1, 0.2]]));
        let labelled = (rows(&[[0.5, 0.6]]), rows(&[[0.0, 1.0]]));
        let p_fake = |row: &[f64; 2]| softmax(&[row[0], row[1], 0.0])[2];
        let expected = -0.5 * (1.0 - p_fake(&[0.1, -0.4])).ln()
            - 0.5 * p_fake(&[1.1, 0.2]).ln()
            - softmax(&[0.5, 0.6])[1].ln();
        let game = Game::FeatureMatching;
        let loss = discriminator(game, real.clone(), fake.clone(), Some(labelled));
        check(&loss, expected);
        let loss = generator(game, || real, fake);
        check(&loss, f64::midpoint(1.0_f64.powi(2), 0.6_f64.powi(2)));
    }

    #[test]
    fn logits_of_any_size_give_finite_losses() {
        for game in [Game::RealOrFake, Game::FakeLevel, Game::FeatureMatching] {
            for sign in [1.0, -1.0] {
                let judged = judged(&[[sign * 1e4, -sign * 1e4]]);
                let loss = discriminator(game, judged.clone(), judged.clone(), None);
                assert!(number(&loss).is_finite(), "{game:?}");
                assert!(number(&generator(game, || judged.clone(), judged.clone())).is_finite());
            }
        }
    }

    #[test]
    fn the_penalty_is_a_mean() {
        let sigma = rows(&[[1.0, 0.0], [0.5, 2.0]]);
        check(&sigma_penalty(sigma), 2.25 / 4.0);
    }
}
