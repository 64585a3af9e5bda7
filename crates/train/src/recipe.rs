//! The methods: recipes of `recipes.toml`, each of which names what learns.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use serde::Deserialize;

use crate::exit::coded;
use crate::settings::{Profile, Settings, overridden};
use hardnessd_core::exit::CONFIG;

/// What learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// The paper's recogniser, on frames.
    Hrn,
    /// A GAN whose discriminator becomes the recogniser (Odena 2016).
    Sgan,
    /// The same with feature matching (Salimans 2016).
    Igan,
    /// A logistic regression on the features of a press.
    Features,
    /// The same on the taxels of the array in parts of the press.
    Taxels,
    /// The network of whole presses.
    Course,
}

/// A method.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// The name in commands, files and tables.
    pub name: String,
    /// What the method is, for `--help`.
    pub about: String,
    /// What learns.
    pub learning: Kind,
    /// The share of the labels that it uses, unless the user names a number.
    pub labels: f64,
    /// Whether the recogniser starts from the discriminator of the USTGAN, without its last layer, and not from
    /// random weights.
    #[serde(default)]
    pub from_ustgan: bool,
    /// Whether the recogniser learns from generated samples first.
    #[serde(default)]
    pub pretrained: bool,
    /// The steps of the training, instead of its epochs.
    steps: Option<BTreeMap<Profile, u64>>,
    #[serde(default)]
    settings: toml::Table,
    /// What profiles change.
    #[serde(default)]
    profiles: BTreeMap<Profile, toml::Table>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    /// What profiles change for all methods.
    profiles: BTreeMap<Profile, toml::Table>,
    recipe: Vec<Recipe>,
}

static ALL: LazyLock<File> = LazyLock::new(|| {
    let text = include_str!("../recipes.toml");
    toml::from_str(text).expect("a test reads the built-in recipes")
});

/// All methods, in the order of the tables.
pub fn all() -> &'static [Recipe] {
    &ALL.recipe
}

/// The parser of a method's name, which lists all methods.
pub fn parser() -> impl TypedValueParser<Value = &'static Recipe> {
    let value = |recipe: &'static Recipe| PossibleValue::new(&*recipe.name).help(&*recipe.about);
    PossibleValuesParser::new(all().iter().map(value))
        .map(|name| named(&name).expect("clap lets only these names pass"))
}

/// The method called `name`.
pub fn named(name: &str) -> Option<&'static Recipe> {
    all().iter().find(|recipe| recipe.name == name)
}

impl Recipe {
    /// Whether the method learns from presses whose level it does not use.
    pub fn needs_unlabelled(&self) -> bool {
        let is_gan = matches!(self.learning, Kind::Sgan | Kind::Igan);
        self.from_ustgan || self.pretrained || is_gan
    }

    /// The settings of a run that learns from `samples` presses. Those of the recipe come on top of the
    /// profile's, and the `given` ones on top of the recipe's.
    ///
    /// # Errors
    ///
    /// Returns an error if a given value lies outside its range.
    pub fn settings(
        &self,
        profile: Profile,
        samples: usize,
        given: &toml::Table,
    ) -> anyhow::Result<Settings> {
        let mut settings = Settings::default();
        let for_all = ALL.profiles.get(&profile).into_iter();
        let own = self.profiles.get(&profile);
        for table in for_all.chain([&self.settings]).chain(own) {
            settings = overridden(&settings, table)?;
        }
        if let Some(&steps) = self.steps.as_ref().and_then(|steps| steps.get(&profile)) {
            // The given batch counts.
            let batch = overridden(&settings, given)?.training.batch;
            let an_epoch = samples.div_ceil(batch).max(1) as u64;
            let epochs = u32::try_from(steps.div_ceil(an_epoch));
            settings.training.epochs = epochs.unwrap_or(u32::MAX);
        }
        let settings = overridden(&settings, given)?;
        settings.check().map_err(|error| coded(CONFIG, error))?;
        Ok(settings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::parse;

    #[test]
    fn all_settings_are_within_their_ranges() {
        for recipe in all() {
            for profile in [Profile::Paper, Profile::Quick, Profile::Smoke] {
                let settings = recipe.settings(profile, 100, &toml::Table::new());
                assert!(settings.is_ok(), "{}: {settings:?}", recipe.name);
            }
        }
    }

    #[test]
    fn given_epochs_count_more_than_a_recipes_steps() {
        let hrn = named("hrn").unwrap();
        let epochs = |given: &str| {
            let given = parse(given).unwrap();
            let settings = hrn.settings(Profile::Quick, 250, &given).unwrap();
            settings.training.epochs
        };
        // 250 samples are three steps of 100, or five of 50.
        assert_eq!(epochs(""), 400);
        assert_eq!(epochs("[training]\nbatch = 50"), 240);
        assert_eq!(epochs("[training]\nepochs = 50"), 50);
    }
}
