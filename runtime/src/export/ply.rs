//! The PLY layout of the reference 3D Gaussian splatting, streamed.

use super::decode::MapGaussian;
use ply_rs_bw::ply::{Addable, ElementDef, Encoding, Header, PropertyAccess, PropertyDef, PropertyType, ScalarType};
use ply_rs_bw::writer::Writer;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Order of the properties in the file; viewers find them by name.
const PROPERTIES: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0",
    "rot_1", "rot_2", "rot_3",
];

/// Value of the zeroth spherical harmonic, by which the file's colors are divided: `1 / (2 sqrt(pi))`.
const SH_C0: f32 = 0.282_094_79;

/// One line of the file.
#[derive(Debug, Clone, Default)]
struct Vertex {
    values: [f32; PROPERTIES.len()],
}

impl Vertex {
    fn from_gaussian(gaussian: &MapGaussian) -> Self {
        let [x, y, z] = gaussian.mean_m;
        let [red, green, blue] = gaussian.rgb.map(|channel| (channel - 0.5) / SH_C0);
        let [s0, s1, s2] = gaussian.log_deviation;
        let [qx, qy, qz, qw] = gaussian.rotation_xyzw;
        let opacity = gaussian.opacity_logit;
        Self { values: [x, y, z, 0.0, 0.0, 0.0, red, green, blue, opacity, s0, s1, s2, qw, qx, qy, qz] }
    }
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self::default()
    }

    fn get_float(&self, name: &str) -> Option<f32> {
        let idx = PROPERTIES.iter().position(|property| *property == name)?;
        self.values.get(idx).copied()
    }
}

/// Writes a PLY file Gaussian by Gaussian. It appears under its name only when it is complete.
pub(super) struct PlyWriter {
    path: PathBuf,
    temporary: PathBuf,
    out: BufWriter<File>,
    writer: Writer<Vertex>,
    element: ElementDef,
    finished: bool,
}

impl PlyWriter {
    /// Begins a file of `n_gaussians` Gaussians.
    pub(super) fn create(path: &Path, n_gaussians: u64) -> io::Result<Self> {
        let mut element = ElementDef::new("vertex".to_owned());
        element.count = usize::try_from(n_gaussians).map_err(io::Error::other)?;
        for name in PROPERTIES {
            element.properties.add(PropertyDef::new(name.to_owned(), PropertyType::Scalar(ScalarType::Float)));
        }
        let mut header = Header::new();
        header.encoding = Encoding::BinaryLittleEndian;
        header.elements.add(element.clone());

        let mut temporary = path.as_os_str().to_owned();
        temporary.push(".part");
        let temporary = PathBuf::from(temporary);
        let mut out = BufWriter::new(File::create(&temporary)?);
        let writer = Writer::new();
        let path = path.to_owned();
        let begun = writer.write_header(&mut out, &header);
        let file = Self { path, temporary, out, writer, element, finished: false };
        begun.map(|_| file)
    }

    pub(super) fn push(&mut self, gaussian: &MapGaussian) -> io::Result<()> {
        let vertex = Vertex::from_gaussian(gaussian);
        self.writer.write_little_endian_element(&mut self.out, &vertex, &self.element).map(|_| ())
    }

    pub(super) fn finish(mut self) -> io::Result<()> {
        self.out.flush()?;
        self.out.get_ref().sync_data()?;
        std::fs::rename(&self.temporary, &self.path)?;
        self.finished = true;
        Ok(())
    }
}

impl Drop for PlyWriter {
    fn drop(&mut self) {
        if !self.finished {
            // The disk may be full; what is half written helps nobody.
            let _ = std::fs::remove_file(&self.temporary);
        }
    }
}
