//! Which part of a map is exported, and how fine.

use super::decode::MapGaussian;
use kilogs_core::map::lod::N_LEVELS;
use kilogs_core::store::PageLabel;
use std::str::FromStr;

/// Options that say what goes into the file; everything at its finest level by default.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct Selection {
    /// Only what stands within this rectangle of the map: x to the right and z ahead of the first camera, m.
    #[arg(long, value_name = "X0,Z0,X1,Z1", allow_hyphen_values = true)]
    pub region: Option<Region>,
    /// Only what the keyframes of this chunk (100 keyframes) spawned; may be given more than once.
    #[arg(long = "chunk", value_name = "N")]
    pub chunks: Vec<u32>,
    /// A smaller file: where there are anchors of this level or a coarser one, leave out finer ones. 0 is the finest.
    #[arg(long, value_name = "LEVEL", default_value_t = 0, value_parser = clap::value_parser!(u8).range(..N_LEVELS as i64))]
    pub finest_level: u8,
    /// Write the anchors of all levels on top of each other, instead of one level at each place.
    #[arg(long, conflicts_with = "finest_level")]
    pub all_levels: bool,
}

impl Selection {
    /// Whether anything of a page is asked for.
    pub(super) fn admits_page(&self, page: &PageLabel) -> bool {
        self.chunks.is_empty() || self.chunks.contains(&page.chunk_id)
    }

    /// Whether a Gaussian is where the file is to be filled.
    pub(super) fn admits(&self, gaussian: &MapGaussian) -> bool {
        self.region.is_none_or(|region| region.contains(gaussian.mean_m))
    }
}

/// A rectangle on the ground of the map frame, m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// Least and most x.
    x_m: [f32; 2],
    /// Least and most z.
    z_m: [f32; 2],
}

impl Region {
    fn contains(&self, [x_m, _, z_m]: [f32; 3]) -> bool {
        (self.x_m[0]..=self.x_m[1]).contains(&x_m) && (self.z_m[0]..=self.z_m[1]).contains(&z_m)
    }
}

impl FromStr for Region {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Result<Vec<f32>, _> = text.split(',').map(|number| number.trim().parse()).collect();
        match numbers.as_deref() {
            Ok(&[x0, z0, x1, z1]) if [x0, z0, x1, z1].iter().all(|number| number.is_finite()) => {
                let between = |a: f32, b: f32| [a.min(b), a.max(b)];
                Ok(Self { x_m: between(x0, x1), z_m: between(z0, z1) })
            }
            _ => Err("four numbers in m are needed, two corners of the rectangle, such as -20,0,20,100".to_owned()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_region_is_two_corners_in_any_order() {
        let region: Region = "20, 100,-20,0".parse().expect("four numbers");
        let check =
            |position_m: [f32; 3], inside: bool| assert_eq!(region.contains(position_m), inside, "{position_m:?}");
        check([0.0, 5.0, 50.0], true);
        check([-20.0, 0.0, 100.0], true);
        check([-20.1, 0.0, 50.0], false);
        check([0.0, 0.0, -0.1], false);
        for bad in ["", "1,2,3", "1,2,3,4,5", "1,2,3,x", "1,2,3,NaN", "0,0,inf,1"] {
            assert!(bad.parse::<Region>().is_err(), "{bad:?}");
        }
    }
}
