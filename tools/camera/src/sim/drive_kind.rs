//! Drives that a filter on images cannot make: other motions, and streets where one plane alone can be seen.

use clap::ValueEnum;

/// How the vehicle drives, and through what.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum DriveKind {
    /// A town with corners and traffic
    #[default]
    Street,
    /// Halfway down a straight street the camera stops, turns on the spot and back, and goes on
    PureRotation,
    /// Stands in traffic for three seconds at the beginning, and again halfway
    StandingThenGo,
    /// From a third of the way on there is nothing to see but the ground
    PlanarRoad,
    /// From a third of the way on there is nothing to see but one long wall beside a bare road
    PlanarWall,
}

/// A place where the vehicle stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stop {
    /// How far along the way, m.
    pub at_m: f64,
    /// For how long, s.
    pub duration_s: f64,
    /// How far it turns to the right on the spot before it turns back, rad.
    pub turn_rad: f64,
}

/// The part of the way where one plane alone can be seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BareStretch {
    /// Where it begins; it goes on to the end, m.
    pub from_m: f32,
    /// The plane is a wall, and the ground has no texture; otherwise it is the ground.
    pub has_wall: bool,
}

impl DriveKind {
    /// The word that means this kind on the command line.
    pub fn name(self) -> String {
        self.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
    }

    /// Whether the way has corners.
    pub fn has_corners(self) -> bool {
        matches!(self, Self::Street | Self::StandingThenGo)
    }

    /// Whether other cars drive.
    pub fn has_traffic(self) -> bool {
        self.has_corners()
    }

    /// Where a drive of this length stands.
    pub fn stops(self, length_m: f64) -> Vec<Stop> {
        let halfway = Stop { at_m: 0.5 * length_m, duration_s: 3.0, turn_rad: 0.0 };
        match self {
            Self::Street | Self::PlanarRoad | Self::PlanarWall => Vec::new(),
            Self::PureRotation => vec![Stop { duration_s: 6.0, turn_rad: 50_f64.to_radians(), ..halfway }],
            Self::StandingThenGo => vec![Stop { at_m: 0.0, ..halfway }, halfway],
        }
    }

    /// Where a drive of this length has one plane alone to see.
    pub fn bare_stretch(self, length_m: f64) -> Option<BareStretch> {
        let is_planar = matches!(self, Self::PlanarRoad | Self::PlanarWall);
        is_planar.then_some(BareStretch { from_m: length_m as f32 / 3.0, has_wall: self == Self::PlanarWall })
    }
}
