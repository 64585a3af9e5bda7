//! The settings of the methods that do not take the defaults of a profile.

use crate::settings::network::Pooling;
use crate::settings::optimiser::{Rule, Schedule};
use crate::settings::{
    AugmentationSettings, Keep, NetworkSettings, OptimiserSettings, Profile, Settings, Training,
    Validation,
};

/// The symmetries and shifts of frames that the methods which are not the paper's learn from.
const SYMMETRIES_AND_SHIFTS: AugmentationSettings = AugmentationSettings {
    symmetries: true,
    shift_taxels: 3,
};

/// The settings of `igan`. The rate is Salimans's. The average covers about a tenth of the steps.
pub(super) fn igan(profile: Profile) -> Settings {
    let mut settings = Settings::of(profile);
    settings.ustgan.optimiser.learning_rate = 3e-3;
    settings.ustgan.averaging = match profile {
        Profile::Paper => 0.9999,
        Profile::Quick => 0.999,
        Profile::Smoke => 0.9,
    };
    settings
}

/// The settings of `ours-steady`. The average covers about 500 steps, six epochs of USTGAN.
pub(super) fn ours_steady(profile: Profile) -> Settings {
    let mut settings = Settings::of(profile);
    for (gan, measured) in [(&mut settings.ustgan, 5), (&mut settings.stgan, 20)] {
        gan.gradient_penalty = 0.001;
        gan.generator_averaging = averaging(profile);
        gan.keep = Keep::Best;
        gan.picture_every_epochs = gan.picture_every_epochs.min(measured);
    }
    settings
}

/// The settings of `hrn15-tuned`, which holds out two of a level's eight objects.
pub(super) fn hrn15_tuned(profile: Profile) -> Settings {
    let mut settings = Settings::of(profile);
    settings.training.epochs *= 5;
    settings.training.optimiser.rule = Rule::Adam;
    settings.validation = Validation {
        share: 0.25,
        every_epochs: 1,
        keep: Keep::Best,
    };
    settings
}

/// The settings of `hrn15-strong`.
pub(super) fn strong(profile: Profile) -> Settings {
    let mut settings = Settings::of(profile);
    settings.network = NetworkSettings {
        pooling: Pooling::MaxMean,
        log_above_n: 0.1,
    };
    settings.training = Training {
        averaging: 0.998,
        checkpoint_every_epochs: 50,
        optimiser: OptimiserSettings {
            rule: Rule::Adam,
            learning_rate: 2e-3,
            schedule: Schedule::Cosine,
            ..settings.training.optimiser
        },
        augmentation: SYMMETRIES_AND_SHIFTS,
        ..settings.training
    };
    settings
}

/// The settings of `frame`.
pub(super) fn frame(profile: Profile) -> Settings {
    let mut settings = Settings::of(profile);
    settings.training = Training {
        epochs: match profile {
            Profile::Paper => 60,
            Profile::Quick => 20,
            Profile::Smoke => 1,
        },
        averaging: averaging(profile),
        optimiser: adam(settings.training.optimiser, 2e-3),
        augmentation: SYMMETRIES_AND_SHIFTS,
        ..settings.training
    };
    settings.validation.share = 0.15;
    settings
}

/// The settings of `course`.
pub fn course(profile: Profile) -> Settings {
    let mut settings = Settings::of(profile);
    settings.training = Training {
        batch: 512,
        epochs: match profile {
            Profile::Paper => 60,
            Profile::Quick => 40,
            Profile::Smoke => 1,
        },
        averaging: match profile {
            Profile::Smoke => 0.0,
            Profile::Paper | Profile::Quick => 0.99,
        },
        checkpoint_every_epochs: 10,
        optimiser: OptimiserSettings {
            weight_decay: 0.1,
            ..adam(settings.training.optimiser, 2e-3)
        },
        ..settings.training
    };
    settings.validation.share = 0.15;
    settings
}

/// The averaging of `frame` and of the generators of `ours-steady`. The steps of a smoke test are too few for an average.
fn averaging(profile: Profile) -> f64 {
    match profile {
        Profile::Smoke => 0.0,
        Profile::Paper | Profile::Quick => 0.998,
    }
}

/// Adam with weight decay, whose rate falls from `learning_rate` to 0 along a cosine. For the
/// networks that are not the paper's.
fn adam(others: OptimiserSettings, learning_rate: f64) -> OptimiserSettings {
    OptimiserSettings {
        rule: Rule::Adam,
        learning_rate,
        schedule: Schedule::Cosine,
        weight_decay: 1e-2,
        ..others
    }
}
