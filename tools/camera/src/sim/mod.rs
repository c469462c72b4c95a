//! The simulated street: a seeded, deterministic town that a camera drives through, with its truth.
//!
//! Given the same settings it delivers the same bytes on every machine of one architecture. Nothing is
//! loaded: houses, markings, cars and trees are solids with band-limited procedural texture.

mod args;
mod candidates;
mod drive_kind;
mod path;
mod render;
mod road_map;
mod shapes;
mod town;
mod true_speed;
mod truth;

pub use args::{SimArgs, SimError, parse_length};
pub use drive_kind::DriveKind;
pub use path::{Drive, Waypoint};
pub use render::VIEW_DISTANCE_M;
pub use true_speed::TrueSpeed;
pub use truth::{TruthRecorder, TruthWriter, write_dataset};

use crate::source::{FrameInfo, FrameSource, PixelFormat, SourceError, SourceFormat, add_noise};
use candidates::{Candidates, Frame};
use kilogs_core::camera::{Mounting, Pinhole};
use kilogs_core::math::Rng;
use render::{Scene, moving_cars};
use town::{Solid, Town};

/// Focal length over image width: KITTI's view of about 81 degrees.
const FOCAL_PER_WIDTH: f64 = 0.58;
/// The optical axis meets the image a little above its middle, as on KITTI.
const PRINCIPAL_Y_PER_HEIGHT: f64 = 0.485;
/// Nominal height of the camera over the road, m.
const CAMERA_HEIGHT_M: f64 = 1.65;

/// The simulator as a source of frames.
pub struct Simulator {
    drive: Drive,
    town: Town,
    camera: Pinhole,
    args: SimArgs,
    /// Index in the drive of the first frame delivered.
    first: usize,
    /// Frames that are delivered.
    n_frames: usize,
    next_frame: usize,
    moving: Vec<Solid>,
    candidates: Candidates,
    rgb: Vec<u8>,
    depth_m: Vec<f32>,
    identity: Vec<u32>,
}

impl Simulator {
    /// Builds the town.
    ///
    /// # Errors
    /// [`SimError::Path`] when `--path` names no usable pose file, [`SimError::Range`] when no frame is left.
    pub fn new(args: &SimArgs) -> Result<Self, SimError> {
        let drive = match &args.path {
            Some(file) => Drive::from_poses(file)?,
            None => Drive::generate(args.drive, args.seed, args.length, args.fps),
        };
        let (first, n_frames) = part_of(drive.n_frames() as u64, args)?;
        let town = Town::build(&drive, args.seed);
        let (width, height) = (f64::from(args.width), f64::from(args.height));
        let focal_px = FOCAL_PER_WIDTH * width;
        let camera = Pinhole {
            width: args.width,
            height: args.height,
            fx: focal_px,
            fy: focal_px,
            cx: 0.5 * width,
            cy: PRINCIPAL_Y_PER_HEIGHT * height,
        };
        let n_pixels = args.width as usize * args.height as usize;
        Ok(Self {
            drive,
            town,
            camera,
            args: args.clone(),
            first,
            n_frames,
            next_frame: 0,
            moving: Vec::new(),
            candidates: Candidates::default(),
            rgb: vec![0; 3 * n_pixels],
            depth_m: vec![0.0; n_pixels],
            identity: vec![0; n_pixels],
        })
    }

    /// Where the camera is at a frame, counted from the first one delivered.
    pub fn camera_at(&self, frame: usize) -> Waypoint {
        self.drive.at_frame(self.first + frame)
    }

    /// What the wheels say at the time of every frame of the drive, with noise of this standard deviation.
    pub fn speeds(&self, sigma_m_per_s: f64) -> TrueSpeed {
        TrueSpeed { drive: self.drive.clone(), fps: self.args.fps, sigma_m_per_s, seed: self.args.seed, frame: 0 }
    }

    /// Number of frames delivered in all.
    pub fn n_frames(&self) -> usize {
        self.n_frames
    }

    /// Depth of the last delivered frame along the optical axis, m, row by row; infinite in the sky.
    pub fn depth_m(&self) -> &[f32] {
        &self.depth_m
    }

    /// Time of a frame, counted from the first one delivered, ns since the beginning of the drive.
    pub fn timestamp_ns(&self, frame: usize) -> u64 {
        ((self.first + frame) as f64 / self.args.fps * 1e9).round() as u64
    }

    /// Renders a frame of the drive.
    fn render(&mut self, frame: usize) {
        let arc_m = self.drive.arc_m(frame);
        let time_s = frame as f64 / self.args.fps;
        self.moving.clear();
        if self.args.drive.has_traffic() {
            moving_cars(&self.drive, arc_m, time_s, self.args.seed as u32, &mut self.moving);
        }
        let frame_camera = Frame::new(self.camera, CAMERA_HEIGHT_M, self.drive.at_frame(frame), VIEW_DISTANCE_M);
        self.candidates.collect(self.town.solids().iter().chain(&self.moving), &frame_camera);
        let scene = Scene { town: &self.town, frame: frame_camera, candidates: &self.candidates };
        scene.render(&mut self.rgb, &mut self.depth_m, &mut self.identity);
        add_noise(&mut self.rgb, self.args.noise, &mut Rng::new(self.args.seed, frame as u64, u64::from(b'n')));
    }
}

/// The first frame to deliver and how many.
fn part_of(n_frames: u64, args: &SimArgs) -> Result<(usize, usize), SimError> {
    let left = n_frames.saturating_sub(args.start);
    match args.frames.map_or(left, |frames| frames.min(left)) {
        0 => Err(SimError::Range { start: args.start, frames: args.frames, n_frames }),
        n => Ok((args.start as usize, n as usize)),
    }
}

impl FrameSource for Simulator {
    fn format(&self) -> SourceFormat {
        SourceFormat {
            camera: self.camera,
            mounting: Some(Mounting {
                height_m: CAMERA_HEIGHT_M,
                pitch_rad: 0.0,
                roll_rad: 0.0,
                forward_axis: [0.0, 0.0, 1.0],
                lever_arm_m: [0.0; 3],
            }),
            pixel_format: if self.args.mono { PixelFormat::Mono8 } else { PixelFormat::Rgb8 },
            n_frames: Some(self.n_frames as u64),
        }
    }

    fn next_frame(&mut self, pixels: &mut [u8]) -> Result<Option<FrameInfo>, SourceError> {
        if self.next_frame >= self.n_frames {
            return Ok(None);
        }
        let frame = self.next_frame;
        self.next_frame += 1;
        self.render(self.first + frame);
        if self.args.mono {
            // BT.601 weights in 8-bit fixed point, as everywhere in the project.
            for (gray, rgb) in pixels.iter_mut().zip(self.rgb.chunks_exact(3)) {
                let weighted = 77 * u32::from(rgb[0]) + 150 * u32::from(rgb[1]) + 29 * u32::from(rgb[2]);
                *gray = ((weighted + 128) >> 8) as u8;
            }
        } else {
            pixels.copy_from_slice(&self.rgb);
        }
        Ok(Some(FrameInfo { timestamp_ns: self.timestamp_ns(frame), exposure_us: 0 }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small() -> SimArgs {
        SimArgs { width: 160, height: 48, length: 30.0, ..SimArgs::default() }
    }

    fn frame(args: &SimArgs, index: usize) -> (Vec<u8>, Vec<f32>) {
        let mut simulator = Simulator::new(args).expect("a generated drive");
        simulator.next_frame = index;
        let mut pixels = vec![0; 3 * 160 * 48];
        simulator.next_frame(&mut pixels).expect("no file is involved").expect("within the drive");
        (pixels, simulator.depth_m().to_vec())
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes_and_another_seed_another_town() {
        assert_eq!(frame(&small(), 3), frame(&small(), 3));
        assert_ne!(frame(&small(), 3).0, frame(&SimArgs { seed: 2, ..small() }, 3).0);
    }

    #[test]
    fn a_part_of_a_drive_is_the_same_as_in_the_whole() {
        let part = SimArgs { start: 4, frames: Some(3), ..small() };
        assert_eq!(frame(&part, 1), frame(&small(), 5));
        let (of_part, whole) = (Simulator::new(&part).expect("a drive"), Simulator::new(&small()).expect("a drive"));
        assert_eq!((of_part.n_frames(), of_part.format().n_frames), (3, Some(3)));
        assert_eq!((of_part.camera_at(2), of_part.timestamp_ns(2)), (whole.camera_at(6), whole.timestamp_ns(6)));
        let mut simulator = Simulator::new(&part).expect("a drive");
        let mut pixels = vec![0; 3 * 160 * 48];
        let n = (0..10).filter(|_| simulator.next_frame(&mut pixels).expect("no file is involved").is_some()).count();
        assert_eq!(n, 3);
    }

    #[test]
    fn a_part_without_frames_is_refused_with_advice() {
        let n = Simulator::new(&small()).expect("a drive").n_frames() as u64;
        let check = |start: u64, frames: Option<u64>, expected: Option<usize>| {
            let found = Simulator::new(&SimArgs { start, frames, ..small() });
            assert_eq!(found.as_ref().ok().map(Simulator::n_frames), expected, "{start} {frames:?}");
            let message = found.err().map(|e| e.to_string()).unwrap_or_default();
            assert_eq!(message.contains("leaves none; start below"), expected.is_none(), "{message}");
        };
        check(0, None, Some(n as usize));
        check(n - 1, Some(7), Some(1));
        check(n, None, None);
        check(u64::MAX, None, None);
        check(0, Some(0), None);
    }

    #[test]
    fn the_road_lies_where_the_camera_height_says() {
        let simulator = Simulator::new(&small()).expect("a generated drive");
        let (camera, (_, depth_m)) = (simulator.camera, frame(&small(), 5));
        let (x, y) = (80, 46);
        let expected_m = CAMERA_HEIGHT_M * camera.fy / (y as f64 + 0.5 - camera.cy);
        assert!(
            (f64::from(depth_m[y * 160 + x]) - expected_m).abs() < 1e-3,
            "{} against {expected_m}",
            depth_m[y * 160 + x]
        );
    }

    #[test]
    fn one_frame_warped_by_the_true_motion_and_depth_predicts_the_next() {
        let args = SimArgs { noise: 0.0, ..small() };
        let simulator = Simulator::new(&args).expect("a generated drive");
        let ((first, depth_m), (second, _)) = (frame(&args, 10), frame(&args, 11));
        let step_m = (simulator.drive.arc_m(11) - simulator.drive.arc_m(10)) as f32;
        let (fx, cx, cy) = (simulator.camera.fx as f32, simulator.camera.cx as f32, simulator.camera.cy as f32);
        let (mut errors, mut still) = (Vec::new(), Vec::new());
        for (y, x) in (26..48).flat_map(|y| (5..155).map(move |x| (y, x))) {
            let z = depth_m[y * 160 + x];
            let shrink = z / (z - step_m);
            let (u, v) = ((x as f32 + 0.5 - cx) * shrink + cx, (y as f32 + 0.5 - cy) * shrink + cy);
            debug_assert!(fx > 0.0);
            let (ux, vy) = (u as usize, v as usize);
            if u < 0.0 || ux >= 160 || vy >= 48 || !z.is_finite() {
                continue;
            }
            let difference = |i: usize, j: usize| f32::from(first[3 * i]) - f32::from(second[3 * j]);
            errors.push(difference(y * 160 + x, vy * 160 + ux).abs());
            still.push(difference(y * 160 + x, y * 160 + x).abs());
        }
        let mean = |v: &[f32]| v.iter().sum::<f32>() / v.len() as f32;
        assert!(mean(&errors) < 0.8 * mean(&still), "warped {} against unmoved {}", mean(&errors), mean(&still));
    }
}
