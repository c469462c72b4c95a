//! Trajectories as text files: TUM (`t x y z qx qy qz qw`) and KITTI (3x4 `world_from_camera`, row by row).

use crate::command::EvalError;
use nalgebra::{Isometry3, Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::path::Path;

/// Where the camera was at one moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose {
    /// Seconds on the recording's clock.
    pub time_s: f64,
    /// Camera in the world, m.
    pub world_from_camera: Isometry3<f64>,
}

/// A ground-truth file: with times of its own (TUM), or one line per image (KITTI).
#[derive(Clone, Debug, PartialEq)]
pub enum Truth {
    /// Poses with times.
    Stamped(Vec<StampedPose>),
    /// Line k is the pose of image k of the data set.
    PerImage(Vec<Isometry3<f64>>),
}

const TUM_COLUMNS: usize = 8;
const KITTI_COLUMNS: usize = 12;

/// Reads a TUM trajectory; `#` starts a comment line.
///
/// # Errors
/// [`EvalError`] naming the file and the line that is wrong.
pub fn read_tum(path: &Path) -> Result<Vec<StampedPose>, EvalError> {
    rows(path)?.iter().map(|row| tum_pose(path, row)).collect()
}

/// Reads a ground-truth file of either kind; 12 numbers a line are KITTI, 8 are TUM.
///
/// # Errors
/// [`EvalError`] naming the file and the line that is wrong.
pub fn read_truth(path: &Path) -> Result<Truth, EvalError> {
    let rows = rows(path)?;
    match rows.first().map(|row| row.n_numbers) {
        Some(TUM_COLUMNS) => rows.iter().map(|row| tum_pose(path, row)).collect::<Result<_, _>>().map(Truth::Stamped),
        _ => rows.iter().map(|row| kitti_pose(path, row)).collect::<Result<_, _>>().map(Truth::PerImage),
    }
}

/// What a line of a ground-truth file in KITTI's format says, for those who read line by line; `None` when it is empty or
/// a comment. Takes no memory.
///
/// # Errors
/// [`EvalError`] naming the file and the line.
pub fn kitti_pose_of_line(path: &Path, line: usize, content: &str) -> Result<Option<Isometry3<f64>>, EvalError> {
    row(path, line, content)?.map(|row| kitti_pose(path, &row)).transpose()
}

/// Reads `times.txt`: one time in seconds per image.
///
/// # Errors
/// [`EvalError`] naming the file and the line that is wrong.
pub fn read_times(path: &Path) -> Result<Vec<f64>, EvalError> {
    rows(path)?.iter().map(|row| numbers::<1>(path, row).map(|[time_s]| time_s)).collect()
}

/// The numbers of one line; those beyond the longest kind are only counted.
struct Row {
    line: usize,
    n_numbers: usize,
    numbers: [f64; KITTI_COLUMNS],
}

fn rows(path: &Path) -> Result<Vec<Row>, EvalError> {
    let text =
        std::fs::read_to_string(path).map_err(|source| EvalError::Unreadable { path: path.to_owned(), source })?;
    text.lines().zip(1..).filter_map(|(content, line)| row(path, line, content).transpose()).collect()
}

/// A line as numbers; `None` when it is empty or a comment.
fn row(path: &Path, line: usize, content: &str) -> Result<Option<Row>, EvalError> {
    let content = content.trim();
    if content.is_empty() || content.starts_with('#') {
        return Ok(None);
    }
    let mut row = Row { line, n_numbers: 0, numbers: [0.0; KITTI_COLUMNS] };
    for word in content.split_whitespace() {
        let number = word.parse().ok().filter(|number: &f64| number.is_finite());
        let number =
            number.ok_or_else(|| malformed(path, line, "holds something that is not a finite number".to_owned()))?;
        if let Some(place) = row.numbers.get_mut(row.n_numbers) {
            *place = number;
        }
        row.n_numbers += 1;
    }
    Ok(Some(row))
}

fn numbers<const N: usize>(path: &Path, row: &Row) -> Result<[f64; N], EvalError> {
    let has_as_many = row.n_numbers == N;
    let found = row.numbers.get(..N).filter(|_| has_as_many).and_then(|numbers| <[f64; N]>::try_from(numbers).ok());
    let layout = match N {
        TUM_COLUMNS => "t x y z qx qy qz qw",
        KITTI_COLUMNS => "a 3x4 matrix, row by row",
        _ => "a time in s",
    };
    let problem = || format!("has {} numbers, {N} are needed: {layout}", row.n_numbers);
    found.ok_or_else(|| malformed(path, row.line, problem()))
}

fn tum_pose(path: &Path, row: &Row) -> Result<StampedPose, EvalError> {
    let [time_s, x, y, z, qx, qy, qz, qw] = numbers::<TUM_COLUMNS>(path, row)?;
    let quaternion = Quaternion::new(qw, qx, qy, qz);
    if quaternion.norm() == 0.0 {
        return Err(malformed(path, row.line, "has a quaternion of length 0".to_owned()));
    }
    let rotation = UnitQuaternion::new_normalize(quaternion);
    Ok(StampedPose { time_s, world_from_camera: Isometry3::from_parts(Translation3::new(x, y, z), rotation) })
}

fn kitti_pose(path: &Path, row: &Row) -> Result<Isometry3<f64>, EvalError> {
    let m = numbers::<KITTI_COLUMNS>(path, row)?;
    let written = Matrix3::new(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]);
    let error = (written.transpose() * written - Matrix3::identity()).abs().max();
    if error > MAX_ROTATION_ERROR || written.determinant() <= 0.0 {
        return Err(malformed(path, row.line, "does not hold a rotation in its first three columns".to_owned()));
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&nearest_rotation(&written));
    let translation = Translation3::from(Vector3::new(m[3], m[7], m[11]));
    Ok(Isometry3::from_parts(translation, rotation))
}

/// Largest entry of `R^T R - I`: files carry about seven digits; a matrix further from a rotation is something else.
const MAX_ROTATION_ERROR: f64 = 1e-2;

/// The rotation closest to a matrix that was rounded for printing (orthogonal Procrustes).
///
/// # Source
/// Golub & Van Loan 2013, "Matrix Computations", section 6.4.1.
fn nearest_rotation(written: &Matrix3<f64>) -> Rotation3<f64> {
    let svd = written.svd(true, true);
    match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => Rotation3::from_matrix_unchecked(u * v_t),
        _ => Rotation3::identity(),
    }
}

fn malformed(path: &Path, line: usize, problem: String) -> EvalError {
    EvalError::Malformed { path: path.to_owned(), line, problem }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth_of(text: &str) -> Result<Truth, String> {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join("truth.txt");
        std::fs::write(&path, text).expect("temporary file");
        read_truth(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn the_number_of_columns_tells_the_format() {
        let kitti = truth_of("0 0 1 5 0 1 0 6 -1 0 0 7\n");
        let Ok(Truth::PerImage(poses)) = kitti else { panic!("{kitti:?}") };
        assert!((poses[0].rotation * Vector3::z() - Vector3::x()).norm() < 1e-12);
        assert_eq!(poses[0].translation.vector, Vector3::new(5.0, 6.0, 7.0));

        let tum = truth_of("# t x y z qx qy qz qw\n1.5 5 6 7 0 0 0 2\n\n");
        let Ok(Truth::Stamped(poses)) = tum else { panic!("{tum:?}") };
        assert_eq!((poses.len(), poses[0].time_s), (1, 1.5));
        assert_eq!(poses[0].world_from_camera.rotation, UnitQuaternion::identity());
    }

    #[test]
    fn a_bad_line_is_named() {
        for (text, complaint) in [
            ("1 0 0 0 0 1 0 0 0 0 1 0\n1 2 3\n", "line 2 has 3 numbers, 12 are needed"),
            ("1 0 0 0 0 1 0 0 0 0 1 nan\n", "line 1 holds something that is not a finite number"),
            ("2 0 0 0 0 2 0 0 0 0 2 0\n", "line 1 does not hold a rotation"),
            ("1 1 0 0 0 1 0 0 0 0 1 0\n", "line 1 does not hold a rotation"),
            ("0 1 1 1 0 0 0 0\n", "line 1 has a quaternion of length 0"),
        ] {
            let error = truth_of(text).expect_err(text);
            assert!(error.contains(complaint), "{error}");
        }
    }
}
