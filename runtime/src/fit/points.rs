//! Surface points of a scene, from a PLY file.

use super::scene::SceneError;
use nalgebra::Point3;
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{Property, PropertyAccess, PropertyAccessResult};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// Points that are kept; of a larger file every n-th.
const MAX_POINTS: usize = 262_144;

#[derive(Debug, Clone, Copy, Default)]
struct Vertex([f64; 3]);

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let axis = match name {
            "x" => 0,
            "y" => 1,
            "z" => 2,
            _ => return PropertyAccessResult::Ignored,
        };
        self.0[axis] = match property {
            Property::Float(value) => f64::from(value),
            Property::Double(value) => value,
            _ => f64::NAN,
        };
        PropertyAccessResult::Set
    }
}

/// Reads the positions of a point cloud; points that are not finite are left out.
///
/// # Errors
/// [`SceneError::File`] when it is missing or no PLY file with vertices.
pub(super) fn read(path: &Path) -> Result<Vec<Point3<f64>>, SceneError> {
    let wrong = |reason: String| SceneError::file(path, format!("{reason}; mend the file or leave ply_file_path out"));
    let mut file = Reader::new(BufReader::new(File::open(path).map_err(|e| wrong(e.to_string()))?));
    let parser = Parser::<Vertex>::new();
    let header = parser.read_header(&mut file).map_err(|e| wrong(e.to_string()))?;
    for (name, element) in &header.elements {
        let vertices =
            parser.read_payload_for_element(&mut file, element, &header).map_err(|e| wrong(e.to_string()))?;
        if name != "vertex" {
            continue;
        }
        let finite = vertices.iter().filter(|vertex| vertex.0.iter().all(|value| value.is_finite()));
        let every = vertices.len().div_ceil(MAX_POINTS).max(1);
        return Ok(finite.step_by(every).map(|vertex| Point3::from(vertex.0)).collect());
    }
    Err(wrong("it has no vertices".to_owned()))
}
