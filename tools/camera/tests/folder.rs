//! Recorded folders: the layouts that are understood, and a clear error for each that is not.

use std::path::{Path, PathBuf};

use image::{GrayImage, Luma, Rgb, RgbImage};
use kilogs_camera::camera_file::{CameraArgument, KITTI_MOUNTING};
use kilogs_camera::source::{FolderSource, ImageList, IndexedFrames, PixelFormat, SourceError, describe};
use kilogs_core::camera::{Lens, Pinhole};
use nalgebra::Vector2;
use tempfile::TempDir;

const CALIB: &str = "P0: 40 0 23.5 0 0 41 15.5 0 0 0 1 0\nP2: 50 0 24 9 0 51 16 9 0 0 1 9\n";
const TIMES: &str = "0.0\n0.1\n0.25\n";

struct Recording {
    folder: TempDir,
}

impl Recording {
    /// Three grey images of 48x32 px in `images/`, calibration and times.
    fn new() -> Self {
        let recording = Self { folder: tempfile::tempdir().expect("a folder") };
        for index in 0..3 {
            recording.image(&format!("images/{index:06}.png"), [48, 32], index as u8);
        }
        recording.text("calib.txt", CALIB);
        recording.text("times.txt", TIMES);
        recording
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn text(&self, name: &str, text: &str) {
        std::fs::write(self.path(name), text).expect("a file");
    }

    fn remove(&self, name: &str) {
        let path = self.path(name);
        if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) }.expect("it was there");
    }

    fn image(&self, name: &str, [width, height]: [u32; 2], value: u8) {
        std::fs::create_dir_all(self.path(name).parent().expect("a folder")).expect("a folder");
        GrayImage::from_pixel(width, height, Luma([value])).save(self.path(name)).expect("an image");
    }

    fn open(&self, camera: Option<&str>, fps: Option<f64>) -> Result<FolderSource, SourceError> {
        FolderSource::open(self.folder.path(), camera.map(CameraArgument::from).as_ref(), fps)
    }
}

fn check_refused(spoil: impl FnOnce(&Recording), fps: Option<f64>, expected: &str) {
    let recording = Recording::new();
    spoil(&recording);
    match recording.open(None, fps) {
        Ok(_) => panic!("not refused: {expected}"),
        Err(error) => assert!(error.to_string().contains(expected), "{error}"),
    }
}

#[test]
fn a_recording_is_read_as_it_is() {
    let recording = Recording::new();
    // A recording's truth is none of the camera's business: here it cannot even be opened.
    std::fs::create_dir(recording.path("poses.txt")).expect("a folder");
    let mut source = recording.open(None, None).expect("a recording");
    let format = source.format();
    assert_eq!((format.camera.width, format.camera.height), (48, 32));
    assert_eq!([format.camera.fx, format.camera.fy, format.camera.cx, format.camera.cy], [40.0, 41.0, 24.0, 16.0]);
    assert_eq!((format.mounting, format.pixel_format, format.n_frames), (None, PixelFormat::Mono8, Some(3)));
    assert_eq!([0, 1, 2].map(|index| source.info(index).timestamp_ns), [0, 100_000_000, 250_000_000]);
    let mut pixels = vec![9; 48 * 32];
    source.read_frame(2, &mut pixels).expect("an image");
    assert_eq!(pixels, [2; 48 * 32]);
}

#[test]
fn each_layout_has_its_calibration_row() {
    let check = |image_folder: &str, fx: f64, pixel_format: PixelFormat| {
        let recording = Recording::new();
        recording.remove("images");
        let path = recording.path(image_folder);
        std::fs::create_dir(&path).expect("a folder");
        for index in 0..3 {
            let name = path.join(format!("{index:010}.jpg"));
            match pixel_format {
                PixelFormat::Mono8 => GrayImage::from_pixel(48, 32, Luma([7])).save(name).expect("an image"),
                _ => RgbImage::from_pixel(48, 32, Rgb([200, 100, 50])).save(name).expect("an image"),
            }
        }
        for dataset in [recording.folder.path(), &path] {
            let format = describe(dataset, None, None).expect("a recording").format;
            assert_eq!((format.camera.fx, format.pixel_format), (fx, pixel_format), "{}", dataset.display());
        }
    };
    check("image_0", 40.0, PixelFormat::Mono8);
    check("image_2", 50.0, PixelFormat::Rgb8);
    check("images", 40.0, PixelFormat::Rgb8);
}

#[test]
fn the_camera_argument_and_the_file_beside_override_the_data_set() {
    let recording = Recording::new();
    let camera = |argument: Option<&str>| {
        let format = recording.open(argument, None).expect("a recording").format();
        (format.camera.fx, format.mounting.map(|mounting| mounting.height_m))
    };
    assert_eq!(camera(None), (40.0, None));
    assert_eq!(camera(Some("kitti")), (40.0, Some(KITTI_MOUNTING.height_m)));
    recording.text("images/camera.toml", "fx = 44\nheight_m = 1.5\n");
    assert_eq!(camera(None), (44.0, Some(1.5)));
    recording.text("camera.toml", "fx = 45\n");
    assert_eq!(camera(Some("kitti")), (45.0, Some(1.65)), "the file in the root goes before the one in the images");
    recording.text("other.toml", "cx = 20\nheight_m = 1.1\n");
    let other = recording.path("other.toml").display().to_string();
    assert_eq!(camera(Some(&other)), (40.0, Some(1.1)), "a file that is named replaces the one that lies there");
    recording.remove("calib.txt");
    recording.text("camera.toml", "fx = 45\nfy = 46\ncx = 24\ncy = 16\n");
    assert_eq!(camera(None), (45.0, None), "a complete file needs no calib.txt");
}

#[test]
fn what_is_missing_is_named() {
    check_refused(|r| r.remove("calib.txt"), None, "calib.txt: No such file");
    check_refused(|r| r.remove("times.txt"), None, "--fps");
    check_refused(|r| r.remove("images"), None, "has no image_0, image_2 or images");
    let empty_folder = |r: &Recording| {
        r.remove("images");
        std::fs::create_dir(r.path("images")).expect("a folder");
        r.text("images/.hidden.png", "");
        r.text("images/readme.txt", "");
    };
    check_refused(empty_folder, None, "the folder has no .png or .jpg images");
    let nowhere = FolderSource::open(Path::new("/nowhere"), None, None).map(|_| ());
    assert!(nowhere.is_err_and(|error| error.to_string().contains("there is no such folder")));
}

#[test]
fn what_cannot_be_believed_is_named() {
    check_refused(|r| r.text("times.txt", "0\n0.2\n0.1\n"), None, "line 3: time goes backwards");
    check_refused(|r| r.text("times.txt", "0\nnan\n0.1\n"), None, "line 2: NaN s");
    check_refused(|r| r.text("times.txt", "0\n0.1\n"), None, "2 times for 3 images");
    check_refused(|r| r.text("calib.txt", "P0: 1 2 3\n"), None, "row P0 has 3 numbers");
    check_refused(|r| r.text("calib.txt", "P1: 1 2 3\n"), None, "there is no row P0 or P2");
    check_refused(|r| r.text("calib.txt", &CALIB.replace("40", "NaN")), None, "\"NaN\" is not a number");
    check_refused(|r| r.text("calib.txt", &CALIB.replace("23.5", "600")), None, "another image size");
    check_refused(|r| r.text("camera.toml", "width = 50\nheight = 32\n"), None, "the images have 48x32 px");
    check_refused(|r| r.text("camera.toml", "hight_m = 2\n"), None, "unknown field `hight_m`");
    check_refused(|r| r.image("images/0.png", [48, 32], 0), None, "are the same frame");
    check_refused(|r| (0..3).for_each(|i| r.text(&format!("images/{i:06}.png"), "x")), None, "no image can be read");
    check_refused(|_| (), Some(f64::NAN), "--fps NaN");
    check_refused(|_| (), Some(0.0), "--fps 0");
}

#[test]
fn a_rate_replaces_the_times() {
    let recording = Recording::new();
    recording.text("times.txt", "no times\n");
    let source = recording.open(None, Some(4.0)).expect("a recording");
    assert_eq!([0, 1, 2].map(|index| source.info(index).timestamp_ns), [0, 250_000_000, 500_000_000]);
}

#[test]
fn a_part_of_a_recording_may_keep_the_times_of_the_whole() {
    let recording = Recording::new();
    recording.remove("images/000000.png");
    let source = recording.open(None, None).expect("a recording");
    assert_eq!([0, 1].map(|index| source.info(index).timestamp_ns), [100_000_000, 250_000_000]);
}

#[test]
fn a_bad_image_is_an_error_of_its_own_and_the_next_one_is_read() {
    let recording = Recording::new();
    let whole = std::fs::read(recording.path("images/000000.png")).expect("an image");
    recording.text("images/000003.png", "");
    recording.image("images/000004.png", [47, 32], 4);
    recording.image("images/000005.jpg", [48, 32], 5);
    std::fs::write(recording.path("images/000000.png"), &whole[..whole.len() / 2]).expect("an image");
    let mut source = recording.open(None, Some(10.0)).expect("a recording");
    let mut check = |index: u64, expected: Result<u8, &str>| {
        let mut pixels = vec![255; 48 * 32];
        match (source.read_frame(index, &mut pixels), expected) {
            (Ok(()), Ok(value)) => assert_eq!(pixels, vec![value; 48 * 32]),
            (Err(error), Err(part)) => assert!(error.to_string().contains(part), "{error}"),
            (result, _) => panic!("frame {index}: {result:?} instead of {expected:?}"),
        }
    };
    check(0, Err("000000.png: "));
    check(1, Ok(1));
    check(3, Err("the file is empty"));
    check(4, Err("the image has 47x32 px, the recording 48x32 px"));
    check(5, Ok(5));
}

#[test]
fn images_of_a_lens_arrive_rectified() {
    const SEEN: Pinhole = Pinhole { width: 48, height: 32, fx: 40.0, fy: 41.0, cx: 24.0, cy: 16.0 };
    let lens = Lens::RadialTangential([-0.3, 0.1, 0.001, -0.002, 0.0]);
    let scenery = |ray: &Vector2<f64>| (128.0 + 90.0 * (3.0 * ray.x).sin() * (4.0 * ray.y).cos()).round() as u8;
    let recording = Recording::new();
    recording.text(
        "camera.toml",
        "model = \"radial_tangential\"\ncoefficients = [-0.3, 0.1, 0.001, -0.002]\nwidth = 48\nheight = 32\n",
    );
    let center = |x: u32, y: u32| SEEN.unproject_z1(&Vector2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
    let photo = GrayImage::from_fn(48, 32, |x, y| Luma([scenery(&lens.undistort(&center(x, y)).expect("a ray"))]));
    photo.save(recording.path("images/000001.png")).expect("an image");
    let ideal: Vec<u8> = (0..48 * 32).map(|i| scenery(&center(i % 48, i / 48))).collect();
    let check = |pixels: &[u8], what: &str| {
        let worst = pixels.iter().zip(&ideal).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst <= Some(2), "{what}: off by {worst:?}");
    };
    assert!(photo.iter().zip(&ideal).any(|(a, b)| a.abs_diff(*b) > 10), "the lens does nothing");
    let mut source = recording.open(None, None).expect("a recording");
    assert_eq!(source.format().camera, SEEN);
    let mut pixels = vec![0; 48 * 32];
    source.read_frame(1, &mut pixels).expect("an image");
    check(&pixels, "frame by frame");
    let described = describe(recording.folder.path(), None, None).expect("a recording");
    let mut list = ImageList::open(described.images).expect("images").rectified(described.distortion);
    list.read(1, &mut pixels).expect("an image");
    check(&pixels, "as a list");
}

#[test]
fn a_lens_that_cannot_be_is_named() {
    let with = |text: &'static str| move |r: &Recording| r.text("camera.toml", text);
    let folds = with("model = \"radial_tangential\"\ncoefficients = [-2.0, 0, 0, 0]\n");
    check_refused(folds, None, "folds back on itself");
    let too_few = with("model = \"kannala_brandt\"\ncoefficients = [0.1]\n");
    check_refused(too_few, None, "kannala_brandt has coefficients [k1, k2, k3, k4], not 1");
}

#[test]
fn the_recordings_of_this_project_are_understood() {
    let data = std::env::var_os("KILOGS_DATA").map_or_else(|| PathBuf::from("../../../shared/data"), PathBuf::from);
    let check = |name: &str, n_frames: u64, size: [u32; 2], pixel_format: PixelFormat, fx_cx: [f64; 2]| {
        let folder = data.join(name);
        if !folder.is_dir() {
            println!("left out: {} is not there", folder.display());
            return;
        }
        let argument = CameraArgument::Kitti;
        let mut source = FolderSource::open(&folder, Some(&argument), None).unwrap_or_else(|e| panic!("{e}"));
        let format = source.format();
        assert_eq!((format.n_frames, format.pixel_format), (Some(n_frames), pixel_format), "{name}");
        assert_eq!([format.camera.width, format.camera.height], size, "{name}");
        assert_eq!([format.camera.fx, format.camera.cx], fx_cx, "{name}");
        let mut pixels = vec![0; format.frame_bytes() as usize];
        source.read_frame(n_frames - 1, &mut pixels).unwrap_or_else(|e| panic!("{e}"));
        assert!(pixels.iter().any(|&value| value > 128), "{name}: the last picture is dark");
    };
    use PixelFormat::{Mono8, Rgb8};
    check("kitti00-0000-1699", 1700, [1241, 376], Mono8, [718.856, 607.6928]);
    check("kitti04-full", 271, [1226, 370], Mono8, [707.0912, 602.3873]);
    check("kitti00-lowres-colour-0000-1017", 1018, [416, 128], Rgb8, [240.970263, 204.039246]);
    check("kitti01-0000-0050", 51, [1241, 376], Mono8, [718.856, 607.6928]);
    check("kitti05-0100-0159-stereo", 60, [1226, 370], Mono8, [707.0912, 602.3873]);
    check("kitti06-0000-0050", 51, [1226, 370], Mono8, [707.0912, 602.3873]);
    check("kittiraw-0926-0060-lidar-colour", 78, [1242, 375], Rgb8, [721.5377, 610.0593]);
}
