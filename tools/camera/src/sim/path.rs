//! The way the vehicle drives: a curve on the ground plane, generated or taken from a pose file.

use super::SimError;
use super::drive_kind::{BareStretch, DriveKind, Stop};
use kilogs_core::math::Rng;
use std::path::Path;

/// A point of the way. `x` right and `z` forward of the start, m; heading 0 looks along +z, positive turns right.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Waypoint {
    /// Position, m.
    pub x: f64,
    /// Position, m.
    pub z: f64,
    /// Heading, rad.
    pub heading_rad: f64,
}

impl Waypoint {
    /// Unit vector of travel, `(x, z)`.
    pub fn forward(&self) -> (f64, f64) {
        (self.heading_rad.sin(), self.heading_rad.cos())
    }

    /// The point `lateral_m` to the right of the way.
    pub fn beside(&self, lateral_m: f64) -> (f64, f64) {
        let (fx, fz) = self.forward();
        (self.x + fz * lateral_m, self.z - fx * lateral_m)
    }
}

/// A drive: the curve sampled every `SPACING_M`, and how far along it the vehicle is at each frame.
#[derive(Debug, Clone)]
pub struct Drive {
    waypoints: Vec<Waypoint>,
    frame_arc_m: Vec<f64>,
    /// How far the camera is turned to the right of the way at each frame; empty where it never is.
    frame_turn_rad: Vec<f64>,
    bare_stretch: Option<BareStretch>,
}

/// Distance between waypoints, m.
pub const SPACING_M: f64 = 1.0;
/// A town's street between two corners, m.
const STRAIGHT_M: (f64, f64) = (55.0, 110.0);
/// Radius of a street corner as a car drives it, m.
const CORNER_RADIUS_M: (f64, f64) = (11.0, 16.0);
/// Town speed on a straight and in a corner, m/s.
const SPEED_M_PER_S: (f64, f64) = (9.0, 5.0);
/// Comfortable braking and accelerating, m/s^2.
const ACCELERATION_M_PER_S2: f64 = 1.5;

impl Drive {
    /// A drive of `length_m`, its look given by `seed`. Corners turn by 90 degrees.
    pub fn generate(kind: DriveKind, seed: u64, length_m: f64, fps: f64) -> Self {
        let mut rng = Rng::new(seed, 0, u64::from(b'p'));
        let mut between = |(low, high): (f64, f64)| low + (high - low) * rng.unit_f64();
        let mut at = Waypoint { x: 0.0, z: 0.0, heading_rad: 0.0 };
        let mut waypoints = vec![at];
        let mut turn_sign = 1.0;
        // The town goes on behind the end, so that the last frame does not look into nothing.
        let built_m = length_m + super::VIEW_DISTANCE_M;
        if !kind.has_corners() {
            advance(&mut at, &mut waypoints, built_m, 0.0);
        }
        while waypoints.len() as f64 * SPACING_M < built_m {
            let straight_m = between(STRAIGHT_M);
            advance(&mut at, &mut waypoints, straight_m, 0.0);
            let radius_m = between(CORNER_RADIUS_M);
            let corner_m = radius_m * std::f64::consts::FRAC_PI_2;
            advance(&mut at, &mut waypoints, corner_m, turn_sign / radius_m);
            // Alternating turns keep a generated town from running into itself.
            turn_sign = -turn_sign;
        }
        let (frame_arc_m, frame_turn_rad) = motion(&waypoints, length_m, fps, &kind.stops(length_m));
        Self { waypoints, frame_arc_m, frame_turn_rad, bare_stretch: kind.bare_stretch(length_m) }
    }

    /// A drive along KITTI poses (one per frame), laid flat on the ground plane: height, pitch and roll are dropped. The camera
    /// looks as the poses do, which is not along the way: it stands ahead of the axle that a vehicle turns about.
    ///
    /// # Errors
    /// [`SimError::Path`] when the file cannot be read, a line has not 12 finite numbers, or it has fewer than two.
    pub fn from_poses(file: &Path) -> Result<Self, SimError> {
        let problem = |reason: String| SimError::Path { path: file.to_owned(), reason };
        let text = std::fs::read_to_string(file).map_err(|e| problem(e.to_string()))?;
        let (mut positions, mut headings_rad) = (Vec::new(), Vec::new());
        for (index, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
            let numbers: Vec<f64> = line.split_whitespace().filter_map(|w| w.parse().ok()).collect();
            match numbers.as_slice() {
                [_, _, look_x, x, _, _, _, _, _, _, look_z, z] if numbers.iter().all(|v| v.is_finite()) => {
                    positions.push((*x, *z));
                    headings_rad.push(look_x.atan2(*look_z));
                }
                _ => return Err(problem(format!("line {} has not 12 finite numbers", index + 1))),
            }
        }
        if positions.len() < 2 {
            return Err(problem("fewer than two poses".to_owned()));
        }
        let frame_arc_m: Vec<f64> = std::iter::once(0.0)
            .chain(positions.windows(2).scan(0.0, |arc_m, pair| {
                *arc_m += (pair[1].0 - pair[0].0).hypot(pair[1].1 - pair[0].1);
                Some(*arc_m)
            }))
            .collect();
        let waypoints = resample(&positions, &frame_arc_m);
        let mut drive = Self { waypoints, frame_arc_m, frame_turn_rad: Vec::new(), bare_stretch: None };
        let turn_rad = |(frame, heading_rad): (usize, f64)| wrap(heading_rad - drive.at_frame(frame).heading_rad);
        drive.frame_turn_rad = headings_rad.into_iter().enumerate().map(turn_rad).collect();
        Ok(drive)
    }

    /// Number of frames.
    pub fn n_frames(&self) -> usize {
        self.frame_arc_m.len()
    }

    /// How far along the way the vehicle is at a frame, m.
    pub fn arc_m(&self, frame: usize) -> f64 {
        self.frame_arc_m[frame.min(self.frame_arc_m.len() - 1)]
    }

    /// The place `arc_m` along the way; beyond either end the way goes straight on.
    pub fn at(&self, arc_m: f64) -> Waypoint {
        let last = self.waypoints.len() - 1;
        let position = arc_m / SPACING_M;
        let base = (position.floor().max(0.0) as usize).min(last.saturating_sub(1));
        let (a, b) = (self.waypoints[base], self.waypoints[(base + 1).min(last)]);
        let t = position - base as f64;
        let turn = wrap(b.heading_rad - a.heading_rad);
        let t_heading = t.clamp(0.0, 1.0);
        Waypoint { x: a.x + (b.x - a.x) * t, z: a.z + (b.z - a.z) * t, heading_rad: a.heading_rad + turn * t_heading }
    }

    /// Where the camera is at a frame, and where it looks.
    pub fn at_frame(&self, frame: usize) -> Waypoint {
        let at = self.at(self.arc_m(frame));
        Waypoint { heading_rad: at.heading_rad + self.frame_turn_rad.get(frame).copied().unwrap_or(0.0), ..at }
    }

    /// The part of the way where one plane alone can be seen. It is straight.
    pub fn bare_stretch(&self) -> Option<BareStretch> {
        self.bare_stretch
    }

    /// The whole way, every `SPACING_M`.
    pub fn waypoints(&self) -> &[Waypoint] {
        &self.waypoints
    }
}

/// Appends `length_m` of constant curvature (1/m, positive turns right).
fn advance(at: &mut Waypoint, waypoints: &mut Vec<Waypoint>, length_m: f64, curvature: f64) {
    let steps = (length_m / SPACING_M).round().max(1.0) as usize;
    for _ in 0..steps {
        let middle_rad = at.heading_rad + 0.5 * curvature * SPACING_M;
        // The chord of an arc is shorter than the arc by sinc(half angle).
        let half_rad = 0.5 * curvature * SPACING_M;
        let chord_m = if half_rad == 0.0 { SPACING_M } else { SPACING_M * half_rad.sin() / half_rad };
        at.x += chord_m * middle_rad.sin();
        at.z += chord_m * middle_rad.cos();
        at.heading_rad += curvature * SPACING_M;
        waypoints.push(*at);
    }
}

/// Arc length and turn on the spot at every frame: corners slowly, straights faster, with bounded acceleration. The
/// vehicle is under way at the beginning unless it stands there.
fn motion(waypoints: &[Waypoint], length_m: f64, fps: f64, stops: &[Stop]) -> (Vec<f64>, Vec<f64>) {
    let limit = speed_limits(waypoints);
    let (mut arcs, mut turns) = (vec![0.0], vec![0.0]);
    let (mut arc_m, mut started_at_m) = (0.0, None);
    let mut stops = stops.iter().peekable();
    while arc_m < length_m {
        let here = ((arc_m / SPACING_M) as usize).min(limit.len() - 1);
        let slowest = ACCELERATION_M_PER_S2 / fps;
        let after = |driven_m: f64| (2.0 * ACCELERATION_M_PER_S2 * driven_m.max(0.0)).sqrt().max(slowest);
        let mut speed = started_at_m.map_or(limit[here], |from_m| limit[here].min(after(arc_m - from_m)));
        if let Some(stop) = stops.peek() {
            let left_m: f64 = stop.at_m - arc_m;
            speed = speed.min(after(left_m));
            if left_m <= speed / fps {
                stand(stop, fps, &mut arcs, &mut turns);
                (arc_m, started_at_m) = (stop.at_m, Some(stop.at_m));
                stops.next();
                continue;
            }
        }
        arc_m += speed / fps;
        arcs.push(arc_m);
        turns.push(0.0);
    }
    (arcs, turns)
}

/// Appends the frames of a stop; a turn begins and ends softly.
fn stand(stop: &Stop, fps: f64, arcs: &mut Vec<f64>, turns: &mut Vec<f64>) {
    let n_frames = (stop.duration_s * fps).round().max(1.0) as usize;
    for frame in 0..=n_frames {
        arcs.push(stop.at_m);
        turns.push(stop.turn_rad * (std::f64::consts::PI * frame as f64 / n_frames as f64).sin().powi(2));
    }
}

/// Speed between waypoints that corners and comfortable pedals allow, m/s.
fn speed_limits(waypoints: &[Waypoint]) -> Vec<f64> {
    let mut speed: Vec<f64> = waypoints
        .windows(2)
        .map(|w| if wrap(w[1].heading_rad - w[0].heading_rad).abs() > 1e-6 { SPEED_M_PER_S.1 } else { SPEED_M_PER_S.0 })
        .collect();
    let reachable = |from: f64| (from * from + 2.0 * ACCELERATION_M_PER_S2 * SPACING_M).sqrt();
    for i in (0..speed.len().saturating_sub(1)).rev() {
        speed[i] = speed[i].min(reachable(speed[i + 1]));
    }
    for i in 1..speed.len() {
        speed[i] = speed[i].min(reachable(speed[i - 1]));
    }
    speed
}

/// Waypoints every [`SPACING_M`] along a polyline whose vertices are at `arc_m`; headings from central differences.
fn resample(positions: &[(f64, f64)], arc_m: &[f64]) -> Vec<Waypoint> {
    let total_m = arc_m[arc_m.len() - 1];
    let n = (total_m / SPACING_M).floor() as usize + 1;
    let mut segment = 0;
    let mut points: Vec<(f64, f64)> = (0..n)
        .map(|i| {
            let s = i as f64 * SPACING_M;
            while segment + 2 < arc_m.len() && arc_m[segment + 1] <= s {
                segment += 1;
            }
            let length = (arc_m[segment + 1] - arc_m[segment]).max(f64::EPSILON);
            let t = (s - arc_m[segment]) / length;
            let (a, b) = (positions[segment], positions[segment + 1]);
            (a.0 + (b.0 - a.0) * t, a.1 + (b.1 - a.1) * t)
        })
        .collect();
    if points.len() < 2 {
        points.push((points[0].0, points[0].1 + SPACING_M));
    }
    let last = points.len() - 1;
    (0..points.len())
        .map(|i| {
            let (before, after) = (points[i.saturating_sub(1)], points[(i + 1).min(last)]);
            let heading_rad = (after.0 - before.0).atan2(after.1 - before.1);
            Waypoint { x: points[i].0, z: points[i].1, heading_rad }
        })
        .collect()
}

/// Angle folded into (-pi, pi].
fn wrap(angle_rad: f64) -> f64 {
    angle_rad.sin().atan2(angle_rad.cos())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_generated_drive_has_the_asked_length_and_corners() {
        let drive = Drive::generate(DriveKind::Street, 1, 300.0, 10.0);
        let driven_m = drive.arc_m(drive.n_frames() - 1);
        assert!((300.0..302.0).contains(&driven_m), "{driven_m}");
        let turned: f64 = drive.waypoints().windows(2).map(|w| wrap(w[1].heading_rad - w[0].heading_rad).abs()).sum();
        assert!(turned > 3.0, "two corners or more, turned {turned} rad");
        let spacing = |w: &[Waypoint]| (w[1].x - w[0].x).hypot(w[1].z - w[0].z);
        assert!(drive.waypoints().windows(2).all(|w| (spacing(w) - SPACING_M).abs() < 0.01));
    }

    #[test]
    fn a_pose_file_is_followed_pose_by_pose() {
        let dir = tempfile::tempdir().expect("temporary folder");
        let file = dir.path().join("poses.txt");
        let lines: Vec<String> =
            (0..20).map(|i| format!("1 0 0 {} 0 1 0 9 0 0 1 {}", 0.0, 2.0 * f64::from(i))).collect();
        std::fs::write(&file, lines.join("\n")).expect("writing poses");
        let drive = Drive::from_poses(&file).expect("valid poses");
        assert_eq!(drive.n_frames(), 20);
        let here = drive.at(drive.arc_m(7));
        assert!((here.z - 14.0).abs() < 1e-9 && here.x.abs() < 1e-9 && here.heading_rad.abs() < 1e-9, "{here:?}");
        assert!((0..20).all(|frame| drive.at_frame(frame).heading_rad.abs() < 1e-9));
        // The way is the same; the camera looks to the right.
        let (sin, cos) = 0.3_f64.sin_cos();
        let turned: Vec<String> =
            (0..20).map(|i| format!("{cos} 0 {sin} 0 0 1 0 9 {} 0 {cos} {}", -sin, 2.0 * f64::from(i))).collect();
        std::fs::write(&file, turned.join("\n")).expect("writing poses");
        let drive = Drive::from_poses(&file).expect("valid poses");
        assert!((0..20).all(|frame| (drive.at_frame(frame).heading_rad - 0.3).abs() < 1e-9));
        assert!(drive.waypoints().iter().all(|at| at.heading_rad.abs() < 1e-9));
        std::fs::write(&file, "1 0 0 0 0 1 0 0 0 0 1 NaN\n").expect("writing poses");
        assert!(matches!(Drive::from_poses(&file), Err(SimError::Path { .. })));
    }

    #[test]
    fn a_drive_stands_and_turns_where_its_kind_says() {
        // Frames that stand, and those among them that turn.
        let check = |kind: DriveKind, standing: usize, turning: usize| {
            let drive = Drive::generate(kind, 1, 120.0, 10.0);
            let frames = || (1..drive.n_frames()).map(|i| (drive.at_frame(i - 1), drive.at_frame(i)));
            let stands = |(a, b): &(Waypoint, Waypoint)| (a.x, a.z) == (b.x, b.z);
            let turns = |(a, b): &(Waypoint, Waypoint)| (a.heading_rad - b.heading_rad).abs() > 1e-6;
            let found = (frames().filter(stands).count(), frames().filter(stands).filter(turns).count());
            assert_eq!(found, (standing, turning), "{kind:?}");
            let step_m = frames().map(|(a, b)| (a.x - b.x).hypot(a.z - b.z)).fold(0.0, f64::max);
            assert!((0.8..0.92).contains(&step_m), "{kind:?}: {step_m} m in a frame");
            assert!(drive.arc_m(drive.n_frames() - 1) >= 120.0, "{kind:?} arrives");
        };
        check(DriveKind::Street, 0, 0);
        check(DriveKind::PureRotation, 60, 60);
        check(DriveKind::StandingThenGo, 61, 0);
        check(DriveKind::PlanarRoad, 0, 0);
    }
}
