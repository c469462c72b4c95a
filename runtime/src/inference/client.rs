//! What the tracker sees of the networks. Takes no memory from the calling thread's heap.

use super::Counts;
use super::mailbox::{Mailbox, NoAnswer, Question, Sheet};
use super::picture::Picture;
use kilogs_core::correspondence::{DepthPrior, ImagePair, PairMatcher, PixelMatch};
use kilogs_core::features::SimdLevel;
use kilogs_core::features::lk::{self, Flow, LkSettings};
use kilogs_core::frame::Pyramid;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::thread::JoinHandle;
use std::time::Duration;

/// The way to the inference thread, which ends with the last client.
#[derive(Debug)]
pub(super) struct Link {
    pub mailbox: Arc<Mailbox>,
    pub counts: Arc<Counts>,
    /// How long an answer may take; without one, as long as it takes.
    pub patience: Option<Duration>,
    pub thread: Option<JoinHandle<()>>,
}

impl Link {
    fn ask<T>(&self, write: impl FnOnce(&mut Sheet), read: impl FnOnce(&Sheet) -> T) -> Option<T> {
        let answer = self.mailbox.ask(self.patience, write, read);
        match answer {
            Ok(_) => self.counts.answered.fetch_add(1, Relaxed),
            Err(NoAnswer::Late) => self.counts.late.fetch_add(1, Relaxed),
            Err(NoAnswer::Gone) => self.counts.failed.fetch_add(1, Relaxed),
        };
        answer.ok()
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.mailbox.close();
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has closed the mailbox and was counted.
            let _ = thread.join();
        }
    }
}

/// How far the search for the exact place may move a match, px: networks place keypoints on whole pixels of an image that
/// may be half as large. Ours.
const MAX_REFINED_PX: f32 = 3.0;

/// What is left of the confidence of a match whose texture looks different. Ours: on KITTI 04 the others lie within a few
/// tenths of a pixel of their epipolar lines, these within one or two.
const UNCONFIRMED: f32 = 0.5;

/// The search for the exact place: tracks' own, on two levels.
const REFINEMENT: LkSettings = LkSettings { n_levels: 2, ..LkSettings::STANDARD };

/// Matches by a trained network, placed exactly by the texture around them where it looks the same.
#[derive(Debug)]
pub(super) struct LearnedMatcher {
    link: Arc<Link>,
    question: Question,
    simd: SimdLevel,
    flows: Vec<Flow>,
}

impl LearnedMatcher {
    /// Finds at most `capacity` matches.
    pub(super) fn new(link: Arc<Link>, question: Question, capacity: usize) -> Self {
        Self { link, question, simd: SimdLevel::new(), flows: Vec::with_capacity(capacity) }
    }

    /// Moves matches to where the keyframe's texture is in the current image.
    fn refine(&mut self, pair: &ImagePair<'_>, matches: &mut [PixelMatch]) {
        self.flows.clear();
        let n = matches.len().min(self.flows.capacity());
        self.flows.extend(matches[..n].iter().map(|found| Flow::new(found.keyframe_px, found.current_px)));
        lk::track(self.simd, pair.keyframe, pair.current, &REFINEMENT, &mut self.flows);
        for (found, flow) in matches.iter_mut().zip(&self.flows) {
            let moved = [0, 1].map(|axis| flow.target_px[axis] - found.current_px[axis]);
            match flow.verdict.is_found() && moved[0].hypot(moved[1]) <= MAX_REFINED_PX {
                true => found.current_px = flow.target_px,
                false => found.confidence *= UNCONFIRMED,
            }
        }
        matches.sort_unstable_by(|a, b| b.confidence.total_cmp(&a.confidence));
    }
}

impl PairMatcher for LearnedMatcher {
    fn match_pair(&mut self, pair: &ImagePair<'_>, matches: &mut [PixelMatch]) -> usize {
        let question = self.question;
        let write = |sheet: &mut Sheet| {
            sheet.question = question;
            sheet.keyframe_ordinal = pair.keyframe_ordinal;
            copy_image(pair.keyframe, &mut sheet.keyframe);
            copy_image(pair.current, &mut sheet.current);
        };
        let read = |sheet: &Sheet| {
            let n = sheet.matches.len().min(matches.len());
            matches[..n].copy_from_slice(&sheet.matches[..n]);
            n
        };
        let n = self.link.ask(write, read).unwrap_or(0);
        self.refine(pair, &mut matches[..n]);
        n
    }
}

/// Depth by a trained network.
#[derive(Debug)]
pub(super) struct LearnedDepth {
    link: Arc<Link>,
}

impl LearnedDepth {
    pub(super) fn new(link: Arc<Link>) -> Self {
        Self { link }
    }
}

impl DepthPrior for LearnedDepth {
    fn depths_m(&mut self, image: &Pyramid<'_>, pixels: &[[f32; 2]], depths_m: &mut [f32]) -> usize {
        depths_m.fill(f32::NAN);
        let write = |sheet: &mut Sheet| {
            sheet.question = Question::Depth;
            copy_image(image, &mut sheet.current);
            sheet.pixels.clear();
            let room = sheet.pixels.capacity();
            sheet.pixels.extend_from_slice(&pixels[..pixels.len().min(room)]);
        };
        let read = |sheet: &Sheet| {
            let known = depths_m.iter_mut().zip(&sheet.depths_m);
            known.map(|(depth_m, &found_m)| *depth_m = found_m).count()
        };
        self.link.ask(write, read);
        depths_m.iter().filter(|depth_m| depth_m.is_finite()).count()
    }
}

/// Copies level 0; an image of another size than was planned for is cut off, or leaves what was there.
fn copy_image(pyramid: &Pyramid<'_>, picture: &mut Picture) {
    let (image, width) = (pyramid.image(), picture.width);
    for (y, to) in picture.pixels.chunks_mut(width.max(1)).enumerate().take(picture.height) {
        let from = image.row(y);
        let n = from.len().min(to.len());
        to[..n].copy_from_slice(&from[..n]);
    }
}
