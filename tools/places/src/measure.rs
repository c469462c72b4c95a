//! What recognition finds on a recording whose true poses are known.

use crate::drive::{Keyframe, Tracked, keyframes};
use crate::error::PlacesError;
use crate::frames::Frames;
use crate::verifier::Verifier;
use kilogs_camera::source::PlaybackRange;
use kilogs_core::conventions::Rigid;
use kilogs_core::places::{
    LoopEvidence, LoopVerdict, PlaceCandidate, PlaceIndex, PlaceRecognizer, PlaceSlot, PlaceStorage, Posting,
    RecognizerSettings, Signature, Tally, Vocabulary, WORDS_PER_PLACE,
};
use kilogs_eval::trajectory::{Truth, read_truth};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Options of `measure`.
#[derive(Debug, clap::Args)]
pub(crate) struct MeasureArgs {
    /// Folder of a recording with `poses.txt`.
    folder: PathBuf,
    /// Vocabulary files; each is measured.
    #[arg(long, required = true)]
    vocabulary: Vec<PathBuf>,
    /// Frames that are left out at the beginning.
    #[arg(long, default_value_t = 0)]
    start: u64,
    /// Frames at most.
    #[arg(long)]
    frames: Option<u64>,
    /// Features of a keyframe that become words.
    #[arg(long, default_value_t = 1024)]
    features: usize,
    /// Described points of a keyframe that are kept; every point is described twice.
    #[arg(long, default_value_t = 1024)]
    points: usize,
    /// Keyframes that the index can hold.
    #[arg(long, default_value_t = 32768)]
    places: usize,
    /// Write every candidate with the numbers that decided.
    #[arg(long)]
    csv: Option<PathBuf>,
}

/// A view counts as a revisit when an old keyframe is so near, m, and looks the same way, rad.
const REVISIT_M: f64 = 5.0;
const REVISIT_RAD: f64 = 0.5;
/// A candidate is right when it is so near, m.
const RIGHT_M: f64 = 15.0;

/// A drive whose true poses are known.
struct Drive {
    keyframes: Vec<Keyframe>,
    truth: Vec<Rigid>,
    min_gap: usize,
}

/// Tracks the recording once, then measures every vocabulary, and the verification of true neighbours.
pub(crate) fn run(args: &MeasureArgs) -> Result<(), PlacesError> {
    let range = PlaybackRange { start: args.start, frames: args.frames, passes: 1 };
    let truth = true_poses(&args.folder)?;
    let frames = Frames::of_folder(&args.folder, &range)?;
    let Tracked { camera, keyframes, .. } = keyframes(frames, args.start, args.features, args.points)?;
    let n_points = keyframes.iter().map(|k| k.points.len()).sum::<usize>() / keyframes.len().max(1);
    println!("{}: {} keyframes, {n_points} described points each", args.folder.display(), keyframes.len());
    let min_gap = RecognizerSettings::STANDARD.min_gap_keyframes as usize;
    let drive = Drive { keyframes, truth, min_gap };
    let mut verifier = Verifier::new(camera, args.points);
    let mut csv = String::from(
        "vocabulary,frame,candidate,score,relative_score,place_score,in_a_row,true_m,true_deg,verdict,matches,epipolar,\
         inliers,spread,disagreement_rad,scale,distance_m\n",
    );
    for path in &args.vocabulary {
        let bytes =
            std::fs::read(path).map_err(|source| PlacesError::File { what: "reading", path: path.clone(), source })?;
        let vocabulary =
            Vocabulary::open(&bytes).map_err(|problem| PlacesError::Vocabulary { path: path.clone(), problem })?;
        recognition(path, &vocabulary, &drive, args.places, &mut verifier, &mut csv)?;
    }
    true_neighbours(&drive, &mut verifier);
    if let Some(path) = &args.csv {
        std::fs::write(path, csv).map_err(|source| PlacesError::File {
            what: "writing",
            path: path.clone(),
            source,
        })?;
    }
    Ok(())
}

pub(crate) fn true_poses(folder: &Path) -> Result<Vec<Rigid>, PlacesError> {
    match read_truth(&folder.join("poses.txt"))? {
        Truth::PerImage(poses) => Ok(poses),
        Truth::Stamped(poses) => Ok(poses.into_iter().map(|pose| pose.world_from_camera).collect()),
    }
}

impl Drive {
    /// True distance, m, and angle, rad, between two keyframes.
    fn apart(&self, a: usize, b: usize) -> (f64, f64) {
        let pose = |i: usize| self.truth[self.keyframes[i].frame as usize];
        let a_from_b = pose(a).inverse() * pose(b);
        (a_from_b.translation.vector.norm(), a_from_b.rotation.angle())
    }

    /// Keyframes that are old enough to be a loop.
    fn old(&self, i: usize) -> std::ops::Range<usize> {
        0..(i + 1).saturating_sub(self.min_gap)
    }

    fn is_revisit(&self, i: usize) -> bool {
        self.old(i).map(|old| self.apart(i, old)).any(|(m, rad)| m < REVISIT_M && rad < REVISIT_RAD)
    }
}

/// Prints one line about the candidates of all keyframes.
fn recognition(
    path: &Path,
    vocabulary: &Vocabulary<'_>,
    drive: &Drive,
    n_places: usize,
    verifier: &mut Verifier,
    csv: &mut String,
) -> Result<(), PlacesError> {
    let storage = PlaceStorage {
        slots: &mut vec![PlaceSlot::UNUSED; n_places],
        postings: &mut vec![Posting::UNUSED; n_places * WORDS_PER_PLACE],
        first_of_word: &mut vec![0; vocabulary.n_words()],
    };
    let mut recognizer = PlaceRecognizer::new(PlaceIndex::new(storage)?, RecognizerSettings::STANDARD);
    let [mut best, mut raw, mut consistent, mut verified, mut all_verified] = [(); 5].map(|()| Counts::default());
    for (i, keyframe) in drive.keyframes.iter().enumerate() {
        let mut tally = vec![Tally::default(); keyframe.features.len()];
        let view = Signature::of(vocabulary, &keyframe.features, &mut tally);
        let (candidates, _) = recognizer.observe(i as u32, &view);
        let is_revisit = drive.is_revisit(i);
        let is_right = |c: &&PlaceCandidate| drive.apart(i, c.ordinal as usize).0 < RIGHT_M;
        let evidence: Vec<_> =
            candidates.iter().map(|c| verifier.verify(keyframe, &drive.keyframes[c.ordinal as usize])).collect();
        let accepted = || candidates.iter().zip(&evidence).filter(|(_, e)| e.verdict == LoopVerdict::Accepted);
        best.note(is_revisit, candidates.iter().take(1).map(|c| is_right(&c)));
        raw.note(is_revisit, candidates.iter().map(|c| is_right(&c)));
        let in_a_row = || candidates.iter().filter(|c| recognizer.is_consistent(c));
        consistent.note(is_revisit, in_a_row().map(|c| is_right(&c)));
        let verified_in_a_row = accepted().map(|(c, _)| c).filter(|c| recognizer.is_consistent(c));
        verified.note(is_revisit, verified_in_a_row.map(|c| is_right(&c)));
        all_verified.note(is_revisit, accepted().map(|(c, _)| is_right(&c)));
        for (candidate, evidence) in candidates.iter().zip(&evidence) {
            note(csv, path, drive, i, candidate, evidence);
        }
    }
    println!("{}:\n  best candidate    {best}\n  all candidates    {raw}", path.display());
    println!("  three in a row    {consistent}\n  of them verified  {verified}\n  of all verified   {all_verified}");
    Ok(())
}

fn note(csv: &mut String, path: &Path, drive: &Drive, i: usize, c: &PlaceCandidate, e: &LoopEvidence) {
    let old = c.ordinal as usize;
    let (true_m, true_rad) = drive.apart(i, old);
    let (name, frame, earlier) = (path.display(), drive.keyframes[i].frame, drive.keyframes[old].frame);
    let (score, relative, place, row) = (c.score, c.relative_score, c.place_score, c.n_consecutive);
    let true_deg = true_rad.to_degrees();
    // Writing into a String cannot fail.
    let _ = writeln!(
        csv,
        "{name},{frame},{earlier},{score:.4},{relative:.3},{place:.4},{row},{true_m:.2},{true_deg:.1},{:?},{},{},{},{:.3},\
         {:.4},{:.4},{:.2}",
        e.verdict, e.n_matches, e.n_epipolar, e.n_inliers, e.spread, e.disagreement_rad, e.scale, e.distance_m
    );
}

/// Degrees of heading at which rows of the table end.
const HEADINGS_DEG: [f64; 7] = [5.0, 15.0, 30.0, 45.0, 60.0, 90.0, 180.0];

/// Verifies each keyframe against the old one that truly looks most alike, and prints how many are accepted by the angle
/// between them: what a recognition that misses nothing would find.
fn true_neighbours(drive: &Drive, verifier: &mut Verifier) {
    let (mut n, mut n_accepted, mut n_matches) = ([0; 7], [0; 7], [0; 7]);
    for i in 0..drive.keyframes.len() {
        let near = drive.old(i).map(|old| (old, drive.apart(i, old))).filter(|(_, (m, _))| *m < RIGHT_M);
        // Ten metres are as bad as sixty degrees.
        let Some((old, (_, rad))) = near.min_by(|(_, a), (_, b)| (a.0 / 10.0 + a.1).total_cmp(&(b.0 / 10.0 + b.1)))
        else {
            continue;
        };
        let row = HEADINGS_DEG.iter().position(|&end| rad.to_degrees() <= end).unwrap_or(HEADINGS_DEG.len() - 1);
        let evidence = verifier.verify(&drive.keyframes[i], &drive.keyframes[old]);
        n[row] += 1;
        n_matches[row] += evidence.n_matches;
        n_accepted[row] += usize::from(evidence.verdict == LoopVerdict::Accepted);
    }
    println!("nearest old keyframe within {RIGHT_M} m, by angle:");
    for (row, end) in HEADINGS_DEG.iter().enumerate().filter(|&(row, _)| n[row] > 0) {
        let mean = n_matches[row] as f64 / f64::from(n[row]);
        println!("  up to {end:3} deg: {} of {} accepted, {mean:.0} matches on average", n_accepted[row], n[row]);
    }
}

/// Candidates against the truth.
#[derive(Debug, Default)]
struct Counts {
    revisits: usize,
    recalled: usize,
    right: usize,
    wrong: usize,
}

impl Counts {
    fn note(&mut self, is_revisit: bool, are_right: impl Iterator<Item = bool>) {
        let (mut right, mut wrong) = (0, 0);
        are_right.for_each(|is| if is { right += 1 } else { wrong += 1 });
        self.revisits += usize::from(is_revisit);
        self.recalled += usize::from(is_revisit && right > 0);
        self.right += right;
        self.wrong += wrong;
    }
}

impl std::fmt::Display for Counts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { revisits, recalled, right, wrong } = self;
        write!(f, "{recalled} of {revisits} revisits; candidates right {right}, wrong {wrong}")
    }
}
