//! One trained network, loaded, checked and optimized for its fixed shapes.

use super::ModelError;
use super::manifest::{Manifest, ModelRow, Port};
use std::sync::Arc;
use tract_onnx::prelude::*;
use tract_onnx::tract_hir::infer::Factoid;

/// A network that is ready to run.
#[derive(Debug)]
pub(super) struct Network {
    row: ModelRow,
    plan: Arc<TypedRunnableModel>,
}

impl Network {
    /// Loads and optimizes the network of `row`.
    pub(super) fn load(manifest: &Manifest, row: &ModelRow) -> Result<Self, ModelError> {
        let bytes = manifest.bytes(row)?;
        let failed = |error: TractError| network_error(row, "loading", &error);
        let mut model = onnx().model_for_read(&mut bytes.as_slice()).map_err(&failed)?;
        drop(bytes);
        let n_inputs = model.input_outlets().map_err(&failed)?.len();
        if n_inputs != row.inputs.len() {
            return Err(wrong_shape(row, "the number of inputs".to_owned(), n_inputs, row.inputs.len()));
        }
        for (idx, port) in row.inputs.iter().enumerate() {
            let declared = model.input_fact(idx).map_err(&failed)?.shape.concretize();
            let declared = declared
                .map(|dims| dims.iter().filter_map(|d| d.to_i64().ok()).map(|d| d as usize).collect::<Vec<_>>());
            if let Some(found) = declared.filter(|found| *found != port.shape) {
                return Err(wrong_shape(row, format!("the shape of input {}", port.name), found, &port.shape));
            }
            model.set_input_fact(idx, f32::fact(port.shape.as_slice()).into()).map_err(&failed)?;
        }
        let plan = model.into_optimized().and_then(|model| model.into_runnable()).map_err(&failed)?;
        check_outputs(row, &plan)?;
        Ok(Self { row: row.clone(), plan })
    }

    /// What the manifest says of it.
    pub(super) fn row(&self) -> &ModelRow {
        &self.row
    }

    /// Runs it; inputs in the order of the manifest, and so are the outputs.
    pub(super) fn run(&self, inputs: TVec<TValue>) -> Result<TVec<TValue>, ModelError> {
        self.plan.run(inputs).map_err(|error| network_error(&self.row, "running", &error))
    }

    /// The numbers of an output.
    pub(super) fn numbers<'a>(&self, output: &'a TValue) -> Result<&'a [f32], ModelError> {
        let view = output.try_as_plain_ram().and_then(|plain| plain.as_slice::<f32>());
        view.map_err(|error| network_error(&self.row, "reading the output of", &error))
    }

    /// An input of the shape that the manifest gives it.
    pub(super) fn input(&self, idx: usize, numbers: &[f32]) -> Result<TValue, ModelError> {
        let tensor = Tensor::from_shape(&self.row.inputs[idx].shape, numbers);
        tensor.map(IntoTValue::into_tvalue).map_err(|error| network_error(&self.row, "filling the input of", &error))
    }
}

fn check_outputs(row: &ModelRow, plan: &TypedRunnableModel) -> Result<(), ModelError> {
    let failed = |error: TractError| network_error(row, "loading", &error);
    let n_outputs = plan.model().output_outlets().map_err(&failed)?.len();
    if n_outputs != row.outputs.len() {
        return Err(wrong_shape(row, "the number of outputs".to_owned(), n_outputs, row.outputs.len()));
    }
    for (idx, Port { name, shape }) in row.outputs.iter().enumerate() {
        let fact = plan.model().output_fact(idx).map_err(&failed)?;
        if fact.shape.as_concrete() != Some(shape.as_slice()) {
            return Err(wrong_shape(row, format!("the shape of output {name}"), &fact.shape, shape));
        }
    }
    Ok(())
}

fn wrong_shape(
    row: &ModelRow,
    what: String,
    found: impl std::fmt::Debug,
    expected: impl std::fmt::Debug,
) -> ModelError {
    let (found, expected) = (format!("{found:?}"), format!("{expected:?}"));
    ModelError::WrongShape { name: row.name.clone(), what, found, expected }
}

fn network_error(row: &ModelRow, doing: &'static str, error: &TractError) -> ModelError {
    ModelError::Network { name: row.name.clone(), doing, reason: format!("{error:#}") }
}
