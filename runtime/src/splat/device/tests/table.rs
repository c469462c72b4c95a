//! The kernel table against the WGSL: every kernel is valid, and names, order, access and layout agree.

use crate::splat::kernels::{Access, KERNELS, Kernel, KernelSpec};
use crate::splat::layout::*;
use crate::splat::program::{Buffer, Part, buffer_plan};
use crate::splat::{Capacities, kernel_constants};
use core::mem::offset_of;

fn parse(spec: &KernelSpec) -> naga::Module {
    let text = spec.wgsl();
    naga::front::wgsl::parse_str(&text).unwrap_or_else(|e| panic!("{}: {}", spec.name, e.emit_to_string(&text)))
}

#[test]
fn every_kernel_is_valid_and_bound_as_the_table_says() {
    for spec in KERNELS {
        let module = parse(spec);
        let mut validator =
            naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::default());
        validator.validate(&module).unwrap_or_else(|e| panic!("{}: {}", spec.name, e.emit_to_string(&spec.wgsl())));
        let mut found: Vec<(u32, String, naga::AddressSpace)> = module
            .global_variables
            .iter()
            .filter_map(|(_, v)| v.binding.map(|b| (b.binding, v.name.clone().unwrap_or_default(), v.space)))
            .collect();
        found.sort_by_key(|f| f.0);
        let storage = |access| naga::AddressSpace::Storage { access };
        let mut expected = vec![(0, "view".to_owned(), naga::AddressSpace::Uniform)];
        expected.extend(spec.bindings.iter().zip(1..).map(|(binding, number)| {
            let access = match binding.access {
                Access::Read => naga::StorageAccess::LOAD,
                Access::ReadWrite => naga::StorageAccess::LOAD | naga::StorageAccess::STORE,
            };
            (number, binding.name.to_owned(), storage(access))
        }));
        assert_eq!(found, expected, "{}", spec.name);
        let [entry] = module.entry_points.as_slice() else { panic!("{} has one entry point", spec.name) };
        assert_eq!((entry.name.as_str(), entry.workgroup_size), ("main", [spec.workgroup_size, 1, 1]), "{}", spec.name);
    }
}

#[test]
fn every_stage_binds_what_its_kernel_asks_for_and_every_kernel_has_a_stage() {
    let mut used = vec![false; KERNELS.len()];
    for stage in Part::ALL.iter().flat_map(|part| part.stages()) {
        used[stage.kernel as usize] = true;
        assert_eq!(stage.buffers.len(), stage.kernel.spec().bindings.len(), "{:?}", stage.kernel);
        assert!(!stage.buffers.contains(&Buffer::View), "{:?} has the view as binding 0", stage.kernel);
    }
    let orphans: Vec<_> = KERNELS.iter().zip(used).filter(|(_, used)| !used).map(|(k, _)| k.name).collect();
    assert!(orphans.is_empty(), "{orphans:?} never run");
    assert_eq!(Kernel::Cull.spec().name, "cull");
}

#[test]
fn every_file_is_in_the_table() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shaders");
    for entry in std::fs::read_dir(folder).expect("shaders") {
        let name = entry.expect("entry").file_name().into_string().expect("utf-8");
        if let Some(stem) = name.strip_suffix(".wgsl") {
            assert!(KERNELS.iter().any(|k| k.name == stem), "{name} has no row in the kernel table");
        }
    }
}

#[test]
fn the_table_for_people_is_the_kernel_table() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shaders/README.md");
    let page = std::fs::read_to_string(path).expect("shaders/README.md");
    let rows: Vec<&str> = page.lines().filter(|line| line.starts_with("| `")).collect();
    assert_eq!(rows.len(), KERNELS.len(), "one row per kernel");
    for (row, spec) in rows.iter().zip(KERNELS) {
        let start = format!("| `{}` | {} | ", spec.name, spec.workgroup_size);
        assert!(row.starts_with(&start), "{row} should start with {start}");
    }
}

/// Checks name, offset and size of every member of one struct in every kernel that has it.
fn check_layout(name: &str, members: &[(&str, usize)], size: usize) {
    let mut seen = false;
    for spec in KERNELS {
        let module = parse(spec);
        for (_, ty) in module.types.iter().filter(|(_, ty)| ty.name.as_deref() == Some(name)) {
            let naga::TypeInner::Struct { members: found, span } = &ty.inner else { panic!("{name} is no struct") };
            let found: Vec<_> =
                found.iter().map(|m| (m.name.as_deref().unwrap_or_default(), m.offset as usize)).collect();
            assert_eq!(found, members, "{name} in {}", spec.name);
            assert_eq!(*span as usize, size, "{name} in {}", spec.name);
            seen = true;
        }
    }
    assert!(seen, "no kernel has {name}");
}

macro_rules! check_layout {
    ($struct:ident { $($member:ident),+ $(,)? }) => {
        check_layout(
            stringify!($struct),
            &[$((stringify!($member), offset_of!($struct, $member))),+],
            size_of::<$struct>(),
        )
    };
}

#[test]
fn structs_agree_member_by_member() {
    check_layout!(ViewBlock {
        width,
        height,
        tile_columns,
        tile_rows,
        n_slots,
        k,
        candidate_capacity,
        entry_capacity,
        pair_capacity,
        first_texel,
        target_kind,
        has_depth,
        focal_px,
        center_px,
        min_z1,
        max_z1,
        stretch_px,
        has_exposure,
        l1_weight,
        ray_corner,
        ray_right,
        ray_down,
        gain,
        bias,
        ssim_weight,
        depth_weight,
        isotropy_weight,
        confidence_sum,
        offset_rate,
        log_scale_rate,
        rotation_rate,
        opacity_rate,
        color_rate,
        background_rate,
        decoder_rows,
        background_step,
        decoder_row,
        decoder_step,
        feature_rate,
        hidden_rate,
        output_offset_rate,
        output_log_scale_rate,
        output_rotation_rate,
        output_opacity_rate,
        output_color_rate,
        finds_pose,
        error_threshold,
        finished_rows,
    });
    check_layout!(DeviceAnchor {
        position_x,
        position_y,
        position_z,
        keyframe_row,
        extent_x,
        extent_y,
        extent_z,
        packed,
    });
    check_layout!(KeyframeBlock { row_x, row_y, row_z });
    check_layout!(Counters {
        candidates_needed,
        candidates,
        visible,
        entries_needed,
        pairs_needed,
        pairs,
        masked_pixels,
        spare,
    });
    check_layout!(Splat {
        mean_x,
        mean_y,
        log2_opacity,
        depth_m,
        conic_xx,
        conic_xy,
        conic_yy,
        rows_px,
        red,
        green,
        blue,
        columns_px,
        extent_x,
        extent_y,
        slope,
        half_px,
    });
    check_layout!(LossReport { sums });
    check_layout!(IndirectGroups { candidates_x, candidates_y, candidates_z, spare });
}

#[test]
fn buffers_are_padded_and_named_once() {
    let plan = buffer_plan(&Capacities::for_map(3, 3, 17, 5));
    for (i, row) in plan.iter().enumerate() {
        assert!(row.bytes() > 0 && row.bytes() % 16 == 0, "{} has {} bytes", row.name, row.bytes());
        assert!(plan[..i].iter().all(|other| other.name != row.name), "{} is there twice", row.name);
    }
    assert_eq!(
        plan[Buffer::Params as usize].elements,
        (3 * 3 * kernel_constants::N_PARAMS as usize).next_multiple_of(4)
    );
}
