//! Every effect changes what it says, in its frames alone, and the same way twice.

use super::*;
use crate::noise::smooth_noise;
use kilogs_core::camera::Pinhole;

const SIZE: [usize; 2] = [160, 64];
const N_FRAMES: u64 = 60;

/// A street of smooth texture that moves by a pixel a frame.
struct Street {
    pixel_format: PixelFormat,
    next: u64,
}

impl FrameSource for Street {
    fn format(&self) -> SourceFormat {
        let [width, height] = SIZE.map(|n| n as u32);
        let camera = Pinhole { width, height, fx: 90.0, fy: 90.0, cx: 80.0, cy: 32.0 };
        SourceFormat { camera, mounting: None, pixel_format: self.pixel_format, n_frames: Some(N_FRAMES) }
    }

    fn next_frame(&mut self, pixels: &mut [u8]) -> Result<Option<FrameInfo>, SourceError> {
        if self.next == N_FRAMES {
            return Ok(None);
        }
        let channels = pixels.len() / (SIZE[0] * SIZE[1]);
        for (i, pixel) in pixels.chunks_exact_mut(channels).enumerate() {
            let (x, y) = ((i % SIZE[0]) as f32 + self.next as f32, (i / SIZE[0]) as f32);
            pixel.fill((110.0 + 80.0 * smooth_noise(0.9 * x, 0.9 * y, 4)) as u8);
        }
        self.next += 1;
        Ok(Some(FrameInfo { timestamp_ns: self.next * 100, exposure_us: 0 }))
    }
}

/// Every frame of the street; `None` where it is missing.
fn play(pixel_format: PixelFormat, words: &[&str]) -> Vec<Option<Vec<u8>>> {
    let degrade = words.iter().map(|word| word.parse().expect("a range")).collect();
    let args = DegradeArgs { degrade, ..DegradeArgs::default() };
    let mut source = Degraded::new(Street { pixel_format, next: 0 }, &args).expect("ranges within the street");
    let mut frames = Vec::new();
    loop {
        let mut pixels = vec![0; source.format().frame_bytes() as usize];
        match source.next_frame(&mut pixels) {
            Ok(Some(info)) => {
                assert_eq!(info.timestamp_ns, (frames.len() as u64 + 1) * 100, "time goes on");
                frames.push(Some(pixels));
            }
            Ok(None) => return frames,
            Err(SourceError::LeftOut { frame }) => {
                assert_eq!(frame, frames.len() as u64);
                frames.push(None);
            }
            Err(other) => panic!("{other}"),
        }
    }
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(sum, n), value| (sum + value, n + 1.0));
    sum / n
}

/// Share of pixels for which `is` holds of the clean and the spoilt value.
fn share(clean: &[u8], spoilt: &[u8], is: impl Fn(u8, u8) -> bool) -> f64 {
    mean(clean.iter().zip(spoilt).map(|(c, s)| f64::from(u8::from(is(*c, *s)))))
}

/// Mean absolute step to the pixel `by` further on.
fn contrast(pixels: &[u8], by: usize) -> f64 {
    mean(pixels.windows(by + 1).map(|w| f64::from(w[0].abs_diff(w[by]))))
}

/// What is to hold of a clean image, the spoilt one and the spoilt one after it.
type Holds<'a> = dyn Fn(&[u8], &[u8], &[u8]) -> bool + 'a;

#[test]
fn every_effect_changes_what_it_says_in_its_frames_alone() {
    let clean = play(PixelFormat::Mono8, &[]);
    let whole = |frame: usize| clean[frame].as_ref().expect("a clean frame");
    let check = |effect: &str, frame: usize, holds: &Holds<'_>| {
        let word = format!("{effect}@10..40");
        let spoilt = play(PixelFormat::Mono8, &[&word]);
        assert_eq!(spoilt, play(PixelFormat::Mono8, &[&word]), "{effect}: the same twice");
        assert!(spoilt[..10] == clean[..10] && spoilt[40..] == clean[40..], "{effect}: frames outside stay");
        let at = |frame: usize| spoilt[frame].as_ref().expect("a spoilt frame");
        assert!(holds(whole(frame), at(frame), at(frame + 1)), "{effect}: frame {frame}");
    };
    let distinct = |pixels: &[u8]| (0..=255).filter(|grey| pixels.contains(grey)).count();
    check("tunnel", 25, &|_, dark, _| distinct(dark) < 16 && dark.iter().all(|&grey| grey < 25));
    check("tunnel", 25, &|_, dark, next| share(dark, next, |a, b| a != b) > 0.5);
    check("tunnel", 34, &|_, exit, _| share(exit, exit, |_, grey| grey == 255) > 0.7);
    check("tunnel", 10, &|clean, entry, _| share(clean, entry, |c, s| s < c) > 0.9 && distinct(entry) > 30);
    check("glare", 25, &|_, glare, _| share(glare, glare, |_, grey| grey == 255) > 0.4);
    check("frozen", 25, &|_, held, next| held == whole(10) && next == whole(10));
    let kept = |clean: &[u8], spoilt: &[u8], by: usize| contrast(spoilt, by) / contrast(clean, by);
    check("blur", 25, &|c, s, _| kept(c, s, 1) < 0.7 * kept(c, s, SIZE[0]));
    check("zoom-blur", 25, &|c, s, _| contrast(&s[..3200], 1) < 0.85 * contrast(&c[..3200], 1));
    check("zoom-blur", 25, &|c, s, _| share(&c[5195..5205], &s[5195..5205], |c, s| c.abs_diff(s) > 12) == 0.0);
    check("noise", 25, &|c, s, _| {
        let variance = mean(c.iter().zip(s).map(|(c, s)| (f64::from(*s) - f64::from(*c)).powi(2)));
        (22.0..28.0).contains(&variance.sqrt())
    });
    check("rain", 25, &|c, s, _| {
        (0.005..0.2).contains(&share(c, s, |c, s| s > c)) && share(c, s, |c, s| s < c) < 0.001
    });
    check("rain", 25, &|_, s, next| share(s, next, |s, next| next > s.saturating_add(20)) > 0.003);
    check("truck", 25, &|c, s, _| (0.45..0.51).contains(&share(c, s, |c, s| c.abs_diff(s) > 2)));
    check("dirt", 25, &|c, s, _| (0.01..0.2).contains(&share(c, s, |c, s| s.saturating_add(20) < c)));
}

#[test]
fn a_gap_leaves_frames_out_and_nothing_else() {
    let (clean, gap) = (play(PixelFormat::Mono8, &[]), play(PixelFormat::Mono8, &["gap@10..20"]));
    for (frame, pixels) in gap.iter().enumerate() {
        assert_eq!(pixels.is_none(), (10..20).contains(&frame), "{frame}");
        assert!(pixels.is_none() || *pixels == clean[frame], "{frame}");
    }
}

#[test]
fn dirt_stays_rain_does_not_and_color_is_spoilt_like_grey() {
    let grey = play(PixelFormat::Mono8, &["dirt@10..40", "noise@20..21"]);
    let at = |frame: usize| grey[frame].as_ref().expect("a frame");
    let hidden = |frame: usize| at(frame).iter().map(|&grey| grey < 30).collect::<Vec<bool>>();
    let both = hidden(12).iter().zip(hidden(30)).filter(|(a, b)| **a && *b).count();
    let either = hidden(12).iter().zip(hidden(30)).filter(|(a, b)| **a || *b).count();
    assert!(either > 0 && 2 * both > either, "{both} of {either}");
    let colored = play(PixelFormat::Rgb8, &["dirt@10..40"]);
    let red: Vec<u8> = colored[12].as_ref().expect("a frame").chunks_exact(3).map(|pixel| pixel[0]).collect();
    assert_eq!(&red, at(12));
}

#[test]
fn the_truck_moves_on_its_own() {
    let frames = play(PixelFormat::Mono8, &["truck@10..40"]);
    let row = |frame: usize| frames[frame].as_ref().expect("a frame")[32 * SIZE[0]..][..SIZE[0]].to_vec();
    let (earlier, later) = (row(20), row(28));
    let difference = |by: usize| -> u32 {
        (20..100).map(|x| u32::from(earlier[x].abs_diff(later[(x + by).min(SIZE[0] - 1)]))).sum()
    };
    let best = (0..40).min_by_key(|&by| difference(by)).expect("a shift");
    // Eight of the 17.4 frames in which it drifts by a quarter of the width.
    assert!((14..=21).contains(&best), "{best} px");
}
