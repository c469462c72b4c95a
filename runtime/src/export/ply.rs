//! The PLY layout of the reference 3D Gaussian splatting, streamed.

use super::decode::MapGaussian;
use super::part_file::PartFile;
use ply_rs_bw::ply::{Addable, ElementDef, Encoding, Header, PropertyAccess, PropertyDef, PropertyType, ScalarType};
use ply_rs_bw::writer::Writer;
use std::io;
use std::path::Path;

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
    out: PartFile,
    writer: Writer<Vertex>,
    element: ElementDef,
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

        let mut out = PartFile::create(path)?;
        let writer = Writer::new();
        writer.write_header(&mut out, &header)?;
        Ok(Self { out, writer, element })
    }

    pub(super) fn push(&mut self, gaussian: &MapGaussian) -> io::Result<()> {
        let vertex = Vertex::from_gaussian(gaussian);
        self.writer.write_little_endian_element(&mut self.out, &vertex, &self.element).map(|_| ())
    }

    pub(super) fn finish(self) -> io::Result<()> {
        self.out.finish()
    }
}
