//! What breaks trackers, put between a source and its publisher: the same on recordings and on the simulated street.

mod args;
mod light;
mod motion;
mod overlay;

pub use args::{Degradation, DegradeArgs, Effect};

use super::{FrameInfo, FrameSource, PixelFormat, SourceError, SourceFormat};
use kilogs_core::math::Rng;

/// The pixels of one packed grey or RGB image.
struct Picture<'a> {
    pixels: &'a mut [u8],
    width: usize,
    height: usize,
    /// Bytes per pixel.
    channels: usize,
}

/// Where in its range of frames a frame lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Place {
    /// Frames of the range before this one.
    since: u64,
    /// Frames of the range from this one on, at least 1.
    left: u64,
}

impl Place {
    fn n_frames(&self) -> u64 {
        self.since + self.left
    }

    /// Share of the range that is over, 0 in the first frame and 1 in the last.
    fn progress(&self) -> f32 {
        self.since as f32 / (self.n_frames() - 1).max(1) as f32
    }

    /// Rises from the first frame to 1 within `n_frames`, and falls to the last likewise.
    fn fade(&self, n_frames: u64) -> f32 {
        ((self.since + 1).min(self.left) as f32 / n_frames as f32).min(1.0)
    }
}

/// A source whose frames are spoilt in stated ranges. Frames are counted as they are played, from 0. The same seed gives
/// the same bytes; frames outside every range stay as they are; nothing is allocated after the start.
pub struct Degraded<Source> {
    source: Source,
    degradations: Vec<Degradation>,
    seed: u64,
    next_frame: u64,
    /// The image that a frozen camera repeats, and the end of the range for which it does.
    held: (Vec<u8>, u64),
    /// The image before it is blurred.
    sharp: Vec<u8>,
}

impl<Source: FrameSource> Degraded<Source> {
    /// Prepares the source.
    ///
    /// # Errors
    /// [`SourceError::Range`] where a range lies behind the last frame, or the pixels are neither grey nor RGB.
    pub fn new(source: Source, args: &DegradeArgs) -> Result<Self, SourceError> {
        let format = source.format();
        args.check(format.n_frames)?;
        if !args.degrade.is_empty() && !matches!(format.pixel_format, PixelFormat::Mono8 | PixelFormat::Rgb8) {
            let found = format.pixel_format;
            return Err(SourceError::Range(format!("--degrade changes Mono8 and Rgb8 images, these are {found:?}")));
        }
        let buffer_for = |wanted: &[Effect]| {
            let is_needed = args.degrade.iter().any(|degradation| wanted.contains(&degradation.effect));
            vec![0; if is_needed { format.frame_bytes() as usize } else { 0 }]
        };
        Ok(Self {
            degradations: args.degrade.clone(),
            seed: args.degrade_seed,
            next_frame: 0,
            held: (buffer_for(&[Effect::Frozen]), 0),
            sharp: buffer_for(&[Effect::Blur, Effect::ZoomBlur]),
            source,
        })
    }

    /// The source behind the filter.
    pub fn into_source(self) -> Source {
        self.source
    }

    fn spoil(&mut self, degradation: Degradation, frame: u64, pixels: &mut [u8]) {
        let format = self.source.format();
        let channels = if format.pixel_format == PixelFormat::Mono8 { 1 } else { 3 };
        let [width, height] = [format.camera.width, format.camera.height].map(|n| n as usize);
        let Degradation { effect, first, end } = degradation;
        let place = Place { since: frame - first, left: end - frame };
        let mut rng = Rng::new(self.seed, frame, effect as u64);
        let mut fixed = Rng::new(self.seed, first, effect as u64);
        let mut picture = Picture { pixels, width, height, channels };
        match effect {
            Effect::Tunnel => light::tunnel(&mut picture, place, &mut rng),
            Effect::Glare => light::glare(&mut picture, place),
            Effect::Noise => light::noise(&mut picture, &mut rng),
            Effect::Blur => motion::blur(&mut picture, &mut self.sharp),
            Effect::ZoomBlur => motion::zoom_blur(&mut picture, &mut self.sharp),
            Effect::Rain => overlay::rain(&mut picture, &mut rng),
            Effect::Truck => overlay::truck(&mut picture, place, fixed.next_u32()),
            Effect::Dirt => overlay::dirt(&mut picture, &mut fixed),
            // Frames are left out and repeated by the source itself.
            Effect::Gap | Effect::Frozen => (),
        }
    }

    /// Repeats the first image of the range.
    fn freeze(&mut self, end: u64, pixels: &mut [u8]) {
        let (held, held_until) = &mut self.held;
        if *held_until == end {
            pixels.copy_from_slice(held);
        } else {
            held.copy_from_slice(pixels);
            *held_until = end;
        }
    }
}

impl<Source: FrameSource> FrameSource for Degraded<Source> {
    fn format(&self) -> SourceFormat {
        self.source.format()
    }

    fn next_frame(&mut self, pixels: &mut [u8]) -> Result<Option<FrameInfo>, SourceError> {
        let frame = self.next_frame;
        self.next_frame += 1;
        let Some(info) = self.source.next_frame(pixels)? else { return Ok(None) };
        let mut frozen_until = None;
        for i in 0..self.degradations.len() {
            let degradation = self.degradations[i];
            match degradation.effect {
                _ if !(degradation.first..degradation.end).contains(&frame) => (),
                Effect::Gap => return Err(SourceError::LeftOut { frame }),
                Effect::Frozen => frozen_until = Some(degradation.end),
                _ => self.spoil(degradation, frame, pixels),
            }
        }
        // Last, so that what is repeated is what was delivered.
        if let Some(end) = frozen_until {
            self.freeze(end, pixels);
        }
        Ok(Some(info))
    }
}

#[cfg(test)]
mod tests;
