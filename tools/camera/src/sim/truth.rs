//! The simulator's truth on disk, in the layout of KITTI odometry.

use super::{CAMERA_HEIGHT_M, SimArgs, SimError, Simulator};
use crate::ipc::Speed;
use crate::source::{
    DegradeArgs, Degraded, FrameInfo, FrameSource, PixelFormat, SPEED_FILE_NAME, SourceError, SourceFormat,
};
use image::{ExtendedColorType, ImageFormat, save_buffer_with_format};
use std::fs::{File, create_dir_all};
use std::io::{LineWriter, Write};
use std::path::{Path, PathBuf};

/// KITTI stores depth as 16-bit steps of 1/256 m, 0 for unknown.
const DEPTH_STEPS_PER_M: f32 = 256.0;

/// Writes `poses.txt`, `times.txt`, `calib.txt`, `camera.toml` and, frame by frame, `depth/NNNNNN.png`.
pub struct TruthWriter {
    folder: PathBuf,
    // Whole lines: whoever ends the simulator early has the truth of what it delivered.
    poses: LineWriter<File>,
    times: LineWriter<File>,
    depth_steps: Vec<u8>,
}

impl TruthWriter {
    /// Creates the folder and the files that do not grow.
    ///
    /// # Errors
    /// [`SimError::Truth`] when the folder cannot be written.
    pub fn create(folder: &Path, simulator: &Simulator) -> Result<Self, SimError> {
        let depth_folder = folder.join("depth");
        create_dir_all(&depth_folder).map_err(|e| problem(&depth_folder, &e))?;
        let camera = simulator.format().camera;
        // KITTI's calibration centres pixels on integers.
        let (cx, cy) = (camera.cx - 0.5, camera.cy - 0.5);
        let row = format!("P0: {} 0 {cx} 0 0 {} {cy} 0 0 0 1 0\n", camera.fx, camera.fy);
        write_text(&folder.join("calib.txt"), &row)?;
        let mounting = format!(
            "height_m = {CAMERA_HEIGHT_M}\npitch_rad = 0.0\nroll_rad = 0.0\nforward_axis = [0.0, 0.0, 1.0]\n\
             lever_arm_m = [0.0, 0.0, 0.0]\n"
        );
        write_text(&folder.join("camera.toml"), &mounting)?;
        if let Some(sigma) = simulator.args.speed_noise {
            let line = |reading: Speed| {
                let Speed { timestamp_ns, metres_per_second, standard_deviation } = reading;
                format!("{:.6} {metres_per_second:.6} {standard_deviation}\n", timestamp_ns as f64 * 1e-9)
            };
            write_text(&folder.join(SPEED_FILE_NAME), &simulator.speeds(sigma).map(line).collect::<String>())?;
        }
        let open = |name: &str| {
            let path = folder.join(name);
            File::create(&path).map(LineWriter::new).map_err(|e| problem(&path, &e))
        };
        let n_pixels = camera.width as usize * camera.height as usize;
        Ok(Self {
            folder: folder.to_owned(),
            poses: open("poses.txt")?,
            times: open("times.txt")?,
            depth_steps: vec![0; 2 * n_pixels],
        })
    }

    /// Appends the truth of the frame that the simulator delivered last.
    ///
    /// # Errors
    /// [`SimError::Truth`], for example on a full disk.
    pub fn write(&mut self, simulator: &Simulator, frame: usize) -> Result<(), SimError> {
        let at = simulator.camera_at(frame);
        let (sin, cos) = at.heading_rad.sin_cos();
        writeln!(self.poses, "{cos:.9e} 0 {sin:.9e} {:.9e} 0 1 0 0 {:.9e} 0 {cos:.9e} {:.9e}", at.x, -sin, at.z)
            .map_err(|e| problem(&self.folder.join("poses.txt"), &e))?;
        writeln!(self.times, "{:.6e}", simulator.timestamp_ns(frame) as f64 * 1e-9)
            .map_err(|e| problem(&self.folder.join("times.txt"), &e))?;
        for (bytes, depth_m) in self.depth_steps.chunks_exact_mut(2).zip(simulator.depth_m()) {
            let steps = depth_m * DEPTH_STEPS_PER_M;
            let stored = if steps <= f32::from(u16::MAX) { steps.round() as u16 } else { 0 };
            bytes.copy_from_slice(&stored.to_ne_bytes());
        }
        let path = self.folder.join(format!("depth/{frame:06}.png"));
        let camera = simulator.format().camera;
        save_buffer_with_format(
            &path,
            &self.depth_steps,
            camera.width,
            camera.height,
            ExtendedColorType::L16,
            ImageFormat::Png,
        )
        .map_err(|e| problem(&path, &e))
    }

    /// Flushes what is buffered.
    ///
    /// # Errors
    /// [`SimError::Truth`], for example on a full disk.
    pub fn finish(mut self) -> Result<(), SimError> {
        self.poses.flush().map_err(|e| problem(&self.folder.join("poses.txt"), &e))?;
        self.times.flush().map_err(|e| problem(&self.folder.join("times.txt"), &e))
    }
}

/// A simulator that writes its truth as it delivers frames.
pub struct TruthRecorder {
    simulator: Simulator,
    writer: TruthWriter,
    n_written: usize,
}

impl TruthRecorder {
    /// Creates the folder of the truth.
    ///
    /// # Errors
    /// [`SimError::Truth`] when it cannot be written.
    pub fn create(folder: &Path, simulator: Simulator) -> Result<Self, SimError> {
        let writer = TruthWriter::create(folder, &simulator)?;
        Ok(Self { simulator, writer, n_written: 0 })
    }

    /// Flushes what is buffered.
    ///
    /// # Errors
    /// [`SimError::Truth`], for example on a full disk.
    pub fn finish(self) -> Result<(), SimError> {
        self.writer.finish()
    }
}

impl FrameSource for TruthRecorder {
    fn format(&self) -> SourceFormat {
        self.simulator.format()
    }

    fn next_frame(&mut self, pixels: &mut [u8]) -> Result<Option<FrameInfo>, SourceError> {
        let delivered = self.simulator.next_frame(pixels)?;
        if delivered.is_some() {
            let written = self.writer.write(&self.simulator, self.n_written);
            written.map_err(|e| SourceError::file(&self.writer.folder, e.to_string()))?;
            self.n_written += 1;
        }
        Ok(delivered)
    }
}

/// Simulates a whole drive into a KITTI-style folder: images, calibration, times and truth. Nothing is published.
/// Images that `degrade` leaves out are missing; their truth is there.
///
/// # Errors
/// [`SimError`] when the way is unusable, a range of `degrade` lies behind the end or the folder cannot be written.
pub fn write_dataset(
    args: &SimArgs,
    degrade: &DegradeArgs,
    folder: &Path,
    mut on_frame: impl FnMut(usize, usize),
) -> Result<(), SimError> {
    let simulator = Simulator::new(args)?;
    let (format, n_frames) = (simulator.format(), simulator.n_frames());
    let (subfolder, color, channels) = match format.pixel_format {
        PixelFormat::Mono8 => ("image_0", ExtendedColorType::L8, 1),
        _ => ("images", ExtendedColorType::Rgb8, 3),
    };
    let images = folder.join(subfolder);
    create_dir_all(&images).map_err(|e| problem(&images, &e))?;
    let mut source = Degraded::new(TruthRecorder::create(folder, simulator)?, degrade)?;
    let camera = format.camera;
    let mut pixels = vec![0; channels * camera.width as usize * camera.height as usize];
    for frame in 0..n_frames {
        match source.next_frame(&mut pixels) {
            Err(SourceError::LeftOut { .. }) => (),
            Err(other) => return Err(problem(&images, &other)),
            Ok(_) => {
                let path = images.join(format!("{frame:06}.png"));
                save_buffer_with_format(&path, &pixels, camera.width, camera.height, color, ImageFormat::Png)
                    .map_err(|e| problem(&path, &e))?;
            }
        }
        on_frame(frame + 1, n_frames);
    }
    source.into_source().finish()
}

fn write_text(path: &Path, text: &str) -> Result<(), SimError> {
    std::fs::write(path, text).map_err(|e| problem(path, &e))
}

fn problem(path: &Path, reason: &dyn std::fmt::Display) -> SimError {
    SimError::Truth { path: path.to_owned(), reason: reason.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_written_drive_is_a_kitti_folder() {
        let dir = tempfile::tempdir().expect("temporary folder");
        let args = SimArgs { width: 64, height: 32, length: 2.0, ..SimArgs::default() };
        let mut last = (0, 0);
        write_dataset(&args, &DegradeArgs::default(), dir.path(), |done, all| last = (done, all))
            .expect("writable folder");
        assert!(last.0 == last.1 && last.0 > 2, "{last:?}");
        let poses = std::fs::read_to_string(dir.path().join("poses.txt")).expect("poses");
        assert_eq!(poses.lines().count(), last.1);
        assert!(poses.lines().all(|l| l.split(' ').filter(|w| w.parse::<f64>().is_ok()).count() == 12), "{poses}");
        let depth = image::open(dir.path().join("depth/000000.png")).expect("depth").into_luma16();
        let (x, y) = (32, 31);
        let expected_m = 1.65 * 0.58 * 64.0 / (31.5 - 0.485 * 32.0);
        assert!((f64::from(depth.get_pixel(x, y).0[0]) / 256.0 - expected_m).abs() < 0.01);
        assert!(matches!(
            TruthWriter::create(Path::new("/proc/no"), &Simulator::new(&args).expect("drive")),
            Err(SimError::Truth { .. })
        ));
    }
}
