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

/// Vertices that are read at once.
const BLOCK_VERTICES: usize = 4096;

#[derive(Debug, Clone, Copy)]
struct Vertex([f64; 3]);

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self([f64::NAN; 3])
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
            Property::Char(value) => f64::from(value),
            Property::UChar(value) => f64::from(value),
            Property::Short(value) => f64::from(value),
            Property::UShort(value) => f64::from(value),
            Property::Int(value) => f64::from(value),
            Property::UInt(value) => f64::from(value),
            _ => f64::NAN,
        };
        PropertyAccessResult::Set
    }
}

/// Reads the positions of a point cloud; points that are not finite are left out.
///
/// # Errors
/// [`SceneError::File`] when it is missing or no PLY file whose vertices have places.
pub(super) fn read(path: &Path) -> Result<Vec<Point3<f64>>, SceneError> {
    read_at_most(path, MAX_POINTS)
}

fn read_at_most(path: &Path, max_points: usize) -> Result<Vec<Point3<f64>>, SceneError> {
    let wrong = |reason: String| SceneError::file(path, format!("{reason}; mend the file or leave ply_file_path out"));
    let mut file = Reader::new(BufReader::new(File::open(path).map_err(|e| wrong(e.to_string()))?));
    let parser = Parser::<Vertex>::new();
    let header = parser.read_header(&mut file).map_err(|e| wrong(e.to_string()))?;
    let Some(vertex) = header.elements.get(VERTEX) else { return Err(wrong("it has no vertices".to_owned())) };
    if let Some(axis) = ["x", "y", "z"].into_iter().find(|&axis| !vertex.properties.contains_key(axis)) {
        return Err(wrong(format!("its vertices have no {axis}")));
    }
    let every = vertex.count.div_ceil(max_points).max(1);
    let mut points = Vec::new();
    for (name, element) in &header.elements {
        let mut first = 0;
        while first < element.count {
            let mut block = element.clone();
            block.count = BLOCK_VERTICES.min(element.count - first);
            let read = parser.read_payload_for_element(&mut file, &block, &header).map_err(|e| wrong(e.to_string()))?;
            if name == VERTEX {
                let kept = (first..).zip(&read).filter(|(nth, vertex)| {
                    nth.is_multiple_of(every) && vertex.0.iter().all(|value| value.is_finite())
                });
                points.extend(kept.map(|(_, vertex)| Point3::from(vertex.0)));
            }
            first += block.count;
        }
        if name == VERTEX {
            break;
        }
    }
    Ok(points)
}

const VERTEX: &str = "vertex";

#[cfg(test)]
mod tests {
    use super::*;

    fn read_text(header: &str, body: &str, max_points: usize) -> Result<Vec<[f64; 3]>, String> {
        let scratch = tempfile::tempdir().expect("a scratch folder");
        let path = scratch.path().join("points.ply");
        let text = format!("ply\nformat ascii 1.0\n{header}end_header\n{body}");
        std::fs::write(&path, text).expect("written");
        let points = read_at_most(&path, max_points).map_err(|error| error.to_string())?;
        Ok(points.into_iter().map(|point| point.coords.into()).collect())
    }

    fn vertices(n: usize, kind: &str) -> String {
        ["x", "y", "z"]
            .iter()
            .fold(format!("element vertex {n}\n"), |text, axis| text + &format!("property {kind} {axis}\n"))
    }

    #[test]
    fn places_are_read_whatever_their_type_and_what_is_not_finite_is_left_out() {
        let body = "1 2 3\n4 5 6\n";
        for kind in ["float", "double", "int", "uchar", "short"] {
            let points = read_text(&vertices(2, kind), body, 10);
            assert_eq!(points, Ok(vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), "{kind}");
        }
        assert_eq!(read_text(&vertices(2, "float"), "1 1e39 3\n4 5 6\n", 10), Ok(vec![[4.0, 5.0, 6.0]]));
        let behind = "element camera 1\nproperty float f\n".to_owned() + &vertices(1, "float");
        assert_eq!(read_text(&behind, "9\n1 2 3\n", 10), Ok(vec![[1.0, 2.0, 3.0]]));
    }

    #[test]
    fn many_are_thinned_evenly_and_a_count_that_is_a_lie_takes_no_memory() {
        let n = 2 * BLOCK_VERTICES + 100;
        let body: String = (0..n).map(|x| format!("{x} 0 0\n")).collect();
        let points = read_text(&vertices(n, "float"), &body, 3).expect("read");
        let every = n.div_ceil(3);
        assert_eq!(points, [0, every, 2 * every].map(|x| [x as f64, 0.0, 0.0]));
        assert!(read_text(&vertices(usize::MAX / 64, "float"), "1 2 3\n", 10).is_err());
    }

    #[test]
    fn vertices_without_a_place_are_refused() {
        let flat = "element vertex 1\nproperty float x\nproperty float y\n";
        assert!(read_text(flat, "1 2\n", 10).unwrap_err().contains("no z"));
        assert!(read_text("element face 0\nproperty float a\n", "", 10).unwrap_err().contains("no vertices"));
    }
}
