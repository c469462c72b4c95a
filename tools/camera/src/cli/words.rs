//! Arguments turned back into the words that were typed.

use super::{CameraArgs, PublishArgs, SimulationArgs, SourceArgs};
use crate::sim::SimArgs;
use std::ffi::OsString;

impl CameraArgs {
    /// The words that parse to these arguments, for a child process.
    pub fn to_words(&self) -> Vec<OsString> {
        let mut words = Words::default();
        let (publish, is_published) = match &self.source {
            SourceArgs::Folder(folder) => {
                words.word("folder").word(&folder.dataset);
                words.option("--camera", folder.camera.as_ref());
                words.option("--fps", folder.fps.map(|fps| fps.to_string()));
                words.option("--speed", folder.speed.as_ref());
                words.option("--start", Some(folder.range.start.to_string()));
                words.option("--frames", folder.range.frames.map(|frames| frames.to_string()));
                words.option("--ping-pong", Some(folder.range.ping_pong.to_string()));
                words.all(folder.degrade.to_words());
                (&folder.publish, true)
            }
            SourceArgs::Sim(SimulationArgs { sim, truth, write, degrade, publish }) => {
                let SimArgs { seed, path, drive, length, start, frames, width, height, fps, mono, noise, speed_noise } =
                    sim;
                words.word("sim").option("--seed", Some(seed.to_string()));
                words.option("--path", path.as_ref());
                words.option("--drive", path.is_none().then(|| drive.name()));
                words.option("--length", Some(length.to_string()));
                words.option("--start", Some(start.to_string()));
                words.option("--frames", frames.map(|frames| frames.to_string()));
                words.option("--width", Some(width.to_string()));
                words.option("--height", Some(height.to_string()));
                words.option("--fps", Some(fps.to_string()));
                words.switch("--mono", *mono);
                words.option("--noise", Some(noise.to_string()));
                words.option("--speed-noise", speed_noise.map(|sigma| sigma.to_string()));
                words.option("--truth", truth.as_ref()).option("--write", write.as_ref());
                words.all(degrade.to_words());
                (publish, write.is_none())
            }
        };
        let PublishArgs { service, live, rate, wait_for_tracker, end_with_tracker, camera_id, quiet } = publish;
        words.option("--service", is_published.then_some(service)).switch("--live", *live);
        words.option("--rate", live.then(|| rate.to_string()));
        words.option("--wait-for-tracker", wait_for_tracker.map(|seconds| seconds.to_string()));
        words.switch("--end-with-tracker", *end_with_tracker);
        words.option("--camera-id", Some(camera_id.to_string())).switch("--quiet", *quiet);
        words.0
    }
}

/// A command line in the making.
#[derive(Default)]
struct Words(Vec<OsString>);

impl Words {
    fn word(&mut self, word: impl Into<OsString>) -> &mut Self {
        self.0.push(word.into());
        self
    }

    /// `name=value` in one word, so that a value may begin with a dash.
    fn option(&mut self, name: &str, value: Option<impl Into<OsString>>) -> &mut Self {
        if let Some(value) = value {
            let mut word = OsString::from(format!("{name}="));
            word.push(value.into());
            self.0.push(word);
        }
        self
    }

    fn all(&mut self, words: Vec<String>) -> &mut Self {
        self.0.extend(words.into_iter().map(OsString::from));
        self
    }

    fn switch(&mut self, name: &str, is_on: bool) -> &mut Self {
        if is_on { self.word(name) } else { self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[test]
    fn arguments_survive_the_way_to_a_child_process() {
        let check = |line: &str| {
            let parse = |words: Vec<OsString>| {
                CameraArgs::try_parse_from([OsString::from("kilogs-camera")].into_iter().chain(words))
                    .unwrap_or_else(|e| panic!("{line}: {e}"))
            };
            let first = parse(line.split(' ').map(OsString::from).collect());
            assert_eq!(format!("{:?}", parse(first.to_words())), format!("{first:?}"), "{line}");
        };
        check("folder data");
        check("folder data --camera kitti --fps 12.5 --start 3 --frames 9 --ping-pong 2 --service a/b --camera-id 4");
        check("folder data --live --rate 0.3 --wait-for-tracker 1.5 --end-with-tracker --quiet");
        check("sim");
        check("sim --seed 9 --path poses.txt --length 50 --width 160 --height 64 --fps 20 --mono --noise 0.5 --live");
        check("sim --start 20 --frames 5 --truth out --service x");
        check("sim --drive planar-wall --speed-noise 0.1");
        check("folder data --speed wheels.txt");
        check("sim --write out --degrade gap@5..7");
        check("folder data --degrade tunnel@5..7 --degrade rain@1..9 --degrade-seed 7");
    }
}
