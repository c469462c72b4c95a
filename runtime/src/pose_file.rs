//! Poses of a recording, read where they are needed: a file with one line per image may be as long as it likes.

use kilogs_core::conventions::Rigid;
use kilogs_eval::command::EvalError;
use kilogs_eval::trajectory::kitti_pose_of_line;
use std::fs::File;
use std::io::{BufRead, BufReader, Seek};
use std::path::{Path, PathBuf};

/// Poses that are in memory at once; whoever goes backwards reads the file from its beginning for each such block.
const BLOCK: usize = 256;

/// A file in KITTI's format, 12 numbers a line. After [`PoseFile::open`], reading takes no memory.
#[derive(Debug)]
pub struct PoseFile {
    path: PathBuf,
    reader: BufReader<File>,
    /// The line that was read last.
    text: String,
    line: usize,
    /// Pose that the reader comes to next.
    next_pose: u64,
    n_poses: u64,
    block: Vec<Rigid>,
    block_begins: u64,
}

impl PoseFile {
    /// Reads the whole file once, so that whatever is wrong with it is said at once.
    ///
    /// # Errors
    /// [`EvalError`] naming the file and the line that is wrong.
    pub fn open(path: &Path) -> Result<Self, EvalError> {
        let reader = File::open(path).map_err(|source| EvalError::Unreadable { path: path.to_owned(), source })?;
        let mut file = Self {
            path: path.to_owned(),
            reader: BufReader::new(reader),
            text: String::new(),
            line: 0,
            next_pose: 0,
            n_poses: 0,
            block: Vec::with_capacity(BLOCK),
            block_begins: 0,
        };
        while file.read_next()?.is_some() {
            file.n_poses += 1;
        }
        file.rewind()?;
        Ok(file)
    }

    /// Poses in the file.
    pub fn n_poses(&self) -> u64 {
        self.n_poses
    }

    /// `world_from_camera` of a line, counted from 0; `None` behind the last.
    ///
    /// # Errors
    /// [`EvalError`] when the file has changed since it was opened.
    pub fn pose(&mut self, nth: u64) -> Result<Option<Rigid>, EvalError> {
        if nth >= self.n_poses {
            return Ok(None);
        }
        let is_there = |file: &Self| (file.block_begins..file.block_begins + file.block.len() as u64).contains(&nth);
        if !is_there(self) {
            self.fill_block(nth / BLOCK as u64 * BLOCK as u64)?;
        }
        Ok(is_there(self).then(|| self.block[(nth - self.block_begins) as usize]))
    }

    fn fill_block(&mut self, begins: u64) -> Result<(), EvalError> {
        self.block.clear();
        self.block_begins = begins;
        if self.next_pose > begins {
            self.rewind()?;
        }
        while self.next_pose < begins {
            if self.read_next()?.is_none() {
                return Ok(());
            }
            self.next_pose += 1;
        }
        while self.block.len() < BLOCK {
            let Some(pose) = self.read_next()? else { break };
            self.next_pose += 1;
            self.block.push(pose);
        }
        Ok(())
    }

    fn rewind(&mut self) -> Result<(), EvalError> {
        (self.next_pose, self.line) = (0, 0);
        self.reader.rewind().map_err(|source| EvalError::Unreadable { path: self.path.clone(), source })
    }

    fn read_next(&mut self) -> Result<Option<Rigid>, EvalError> {
        loop {
            self.text.clear();
            let read = self.reader.read_line(&mut self.text);
            if read.map_err(|source| EvalError::Unreadable { path: self.path.clone(), source })? == 0 {
                return Ok(None);
            }
            self.line += 1;
            if let Some(pose) = kitti_pose_of_line(&self.path, self.line, &self.text)? {
                return Ok(Some(pose));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seal;

    #[test]
    fn any_line_is_found_in_any_order_without_taking_memory() {
        const N: u64 = 3 * BLOCK as u64 + 7;
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("poses.txt");
        let lines = (0..N).map(|k| format!("1 0 0 {k} 0 1 0 0 0 0 1 0\n# a comment\n"));
        std::fs::write(&path, lines.collect::<String>()).expect("a file");
        let mut file = PoseFile::open(&path).expect("a pose file");
        let sealed = seal::enter();
        for nth in (0..N).chain((0..N).rev()).chain([N - 1, 0, 2 * BLOCK as u64, 1]) {
            let pose = file.pose(nth);
            assert!(pose.is_ok_and(|pose| pose.is_some_and(|pose| pose.translation.x == nth as f64)), "{nth}");
        }
        assert!(file.pose(N).is_ok_and(|pose| pose.is_none()));
        assert_eq!((sealed.violations(), file.block.capacity()), ((0, 0), BLOCK));
    }
}
