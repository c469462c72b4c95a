//! Which frames are spoilt, and how, as typed.

use crate::source::SourceError;
use clap::ValueEnum;
use std::fmt;
use std::str::FromStr;

/// What can befall a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Effect {
    /// A tunnel: a few grey values and the noise that stays, then glare at the exit
    Tunnel,
    /// The sun in the lens: saturated, with a bloom
    Glare,
    /// The image of the first frame repeats bit by bit while time goes on
    Frozen,
    /// The frames are missing
    Gap,
    /// Blur along the rows, as of a fast turn
    Blur,
    /// Blur away from the image's centre, as of fast driving
    ZoomBlur,
    /// Heavy noise of the sensor
    Noise,
    /// Thin bright streaks, other ones in every frame
    Rain,
    /// A truck that fills half of the view and moves on its own
    Truck,
    /// Dark blobs that stay where they are on the lens
    Dirt,
}

impl Effect {
    fn name(self) -> String {
        self.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
    }
}

/// One effect in one range of frames, written `tunnel@100..140`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Degradation {
    /// What happens.
    pub effect: Effect,
    /// First frame, counted as they are played from 0.
    pub first: u64,
    /// One past the last frame.
    pub end: u64,
}

impl FromStr for Degradation {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let Some((name, range)) = text.split_once('@') else {
            return Err("write what happens and when, for example tunnel@100..140".to_owned());
        };
        let effect = Effect::from_str(name, false).map_err(|_| {
            let names: Vec<String> = Effect::value_variants().iter().map(|effect| effect.name()).collect();
            format!("\"{name}\" is none of {}", names.join(", "))
        })?;
        let bounds = range.split_once("..").and_then(|(first, end)| Some((first.parse().ok()?, end.parse().ok()?)));
        match bounds {
            Some((first, end)) if first < end => Ok(Self { effect, first, end }),
            _ => {
                Err(format!("\"{range}\" is no range of frames; write FIRST..END with FIRST below END, like 100..140"))
            }
        }
    }
}

impl fmt::Display for Degradation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}..{}", self.effect.name(), self.first, self.end)
    }
}

/// What is done to frames before they are published.
#[derive(Clone, Debug, PartialEq, Eq, clap::Args)]
pub struct DegradeArgs {
    /// Spoil frames FIRST..END (counted as they are played, from 0; END is the first that is whole again), for example
    /// `tunnel@100..140`. May be given more than once; WHAT is one of: tunnel (dark with a few grey values, glare at the
    /// exit), glare, frozen (the first image repeats), gap (frames are missing), blur (along the rows), zoom-blur (from
    /// the centre), noise (sigma 25), rain (bright streaks), truck (fills half of the view), dirt (blobs on the lens).
    #[arg(long, value_name = "WHAT@FIRST..END")]
    pub degrade: Vec<Degradation>,
    /// Seed of what is spoilt.
    #[arg(long, default_value_t = 1, value_name = "N")]
    pub degrade_seed: u64,
}

/// Nothing is spoilt.
impl Default for DegradeArgs {
    fn default() -> Self {
        Self { degrade: Vec::new(), degrade_seed: 1 }
    }
}

impl DegradeArgs {
    /// Whether every range begins within `n_frames`.
    ///
    /// # Errors
    /// [`SourceError::Range`] naming the range that does not.
    pub fn check(&self, n_frames: Option<u64>) -> Result<(), SourceError> {
        let beyond = |degradation: &&Degradation| n_frames.is_some_and(|n| degradation.first >= n);
        match (self.degrade.iter().find(beyond), n_frames) {
            (Some(degradation), Some(n)) => Err(SourceError::Range(format!(
                "--degrade {degradation} begins behind the last of {n} frames; begin below {n}"
            ))),
            _ => Ok(()),
        }
    }

    /// The words that parse to these arguments, for a child process.
    pub fn to_words(&self) -> Vec<String> {
        let each = self.degrade.iter().map(|degradation| format!("--degrade={degradation}"));
        each.chain([format!("--degrade-seed={}", self.degrade_seed)]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_is_read_or_refused_with_advice() {
        let check =
            |text: &str, expected: Result<(Effect, u64, u64), &str>| match (text.parse::<Degradation>(), expected) {
                (Ok(found), Ok((effect, first, end))) => {
                    assert_eq!(found, Degradation { effect, first, end }, "{text}");
                    assert_eq!(found.to_string(), text);
                }
                (Err(found), Err(part)) => assert!(found.contains(part), "{text}: {found}"),
                (found, expected) => panic!("{text}: {found:?} instead of {expected:?}"),
            };
        check("tunnel@100..140", Ok((Effect::Tunnel, 100, 140)));
        check("zoom-blur@0..1", Ok((Effect::ZoomBlur, 0, 1)));
        for bad in ["gap@5..5", "gap@6..5", "gap@-1..5", "gap@1", "gap@..", "gap@1..2..3", "gap@1..x"] {
            check(bad, Err("FIRST below END"));
        }
        check("fog@1..2", Err("none of tunnel, glare, frozen"));
        check("gap", Err("tunnel@100..140"));
    }

    #[test]
    fn a_range_behind_the_last_frame_is_refused() {
        let args = DegradeArgs { degrade: vec!["gap@3..9".parse().expect("a range")], ..DegradeArgs::default() };
        assert!(args.check(Some(4)).is_ok() && args.check(None).is_ok());
        let refusal = args.check(Some(3)).map_err(|e| e.to_string());
        assert!(
            refusal.as_ref().is_err_and(|text| text.contains("gap@3..9 begins behind the last of 3")),
            "{refusal:?}"
        );
    }
}
