//! Shaders are valid, and share the layout of their structs with the host.

use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{Module, TypeInner};

use super::host::{
    BatchData, BoxData, BrickData, ConstantData, CutData, DigitData, JobData, LightingData, PlanesData,
    ScanData, SightData, StageData, ValuesData, ViewData,
};
use super::import::{
    BYTES, CELL_BIN, CELL_GRADIENTS, CELL_ORDER, CELL_PLACE, CELL_SCAN, CELL_SORT, CELL_TILES, CELL_VALUES,
    DECODE, RAYCAST, SHARED, SLICES, with_imports,
};

#[track_caller]
fn parsed(name: &str, text: &str) -> Module {
    let module =
        naga::front::wgsl::parse_str(text).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(text)));
    // Halves in pairs, which WebGPU guarantees.
    let capabilities = Capabilities::SHADER_FLOAT16_IN_FLOAT32;
    let mut validator = Validator::new(ValidationFlags::all(), capabilities);
    validator.validate(&module).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(text)));
    module
}

/// Offset and size of each member of a struct, but for padding; and the size of the struct.
fn layout_in(module: &Module, name: &str) -> (Vec<(String, u32, u32)>, u32) {
    let ty = module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some(name));
    let Some(TypeInner::Struct { members, span }) = ty.map(|(_, ty)| &ty.inner) else {
        panic!("no struct {name}")
    };
    let layout = members.iter().map(|member| {
        let size = module.types[member.ty].inner.size(module.to_ctx());
        (member.name.clone().unwrap(), member.offset, size)
    });
    (layout.filter(|(name, ..)| !name.starts_with("padding")).collect(), *span)
}

/// The same of a struct of the host.
macro_rules! layout_of {
    ($ty:ident { $($field:ident),* $(,)? }) => {{
        let value: $ty = bytemuck::Zeroable::zeroed();
        let fields = vec![$((
            stringify!($field).to_owned(),
            std::mem::offset_of!($ty, $field) as u32,
            size_of_val(&value.$field) as u32,
        )),*];
        (fields, size_of::<$ty>() as u32)
    }};
}

#[test]
fn every_shader_is_valid() {
    parsed("bytes.wgsl", BYTES);
    parsed("decode.wgsl", &with_imports(DECODE));
    parsed("raycast.wgsl", &with_imports(RAYCAST));
    parsed("slices.wgsl", &with_imports(SLICES));
    parsed("tests/twins.wgsl", &with_imports(include_str!("shaders/tests/twins.wgsl")));
    for (name, text) in CELLS {
        parsed(name, &with_imports(text));
    }
    let declared = "@group(0) @binding(0) var<storage, read> bank: array<u32>;\n\
                    @group(0) @binding(1) var<storage, read> nodes: array<u32>;\n";
    // Sampling is valid where what it calls is imported, as above.
    for (name, text) in SHARED.iter().filter(|(name, _)| *name != "shared/sampling.wgsl") {
        parsed(name, &format!("{declared}{text}"));
    }
}

/// Shaders that draw meshes.
const CELLS: [(&str, &str); 8] = [
    ("bin.wgsl", CELL_BIN),
    ("gradients.wgsl", CELL_GRADIENTS),
    ("order.wgsl", CELL_ORDER),
    ("place.wgsl", CELL_PLACE),
    ("scan.wgsl", CELL_SCAN),
    ("sort.wgsl", CELL_SORT),
    ("tiles.wgsl", CELL_TILES),
    ("values.wgsl", CELL_VALUES),
];

/// What WebGPU guarantees of a stage: storage buffers, bytes of workgroup memory, and invocations of a workgroup.
#[test]
fn shaders_for_meshes_stay_within_what_is_guaranteed() {
    for (name, text) in CELLS {
        let module = parsed(name, &with_imports(text));
        let num_storage = module
            .global_variables
            .iter()
            .filter(|(_, v)| matches!(v.space, naga::AddressSpace::Storage { .. }))
            .count();
        assert!(num_storage <= 8, "{name}: {num_storage}");
        let workgroup = module
            .global_variables
            .iter()
            .filter(|(_, v)| v.space == naga::AddressSpace::WorkGroup)
            .map(|(_, v)| module.types[v.ty].inner.size(module.to_ctx()))
            .sum::<u32>();
        assert!(workgroup <= 16384, "{name}: {workgroup}");
        for entry in &module.entry_points {
            assert!(entry.workgroup_size.iter().product::<u32>() <= 256, "{name}");
        }
    }
}

#[test]
fn structs_of_meshes_are_laid_out_alike() {
    let [bin, scan, sort, values, gradients] = [CELL_BIN, CELL_SCAN, CELL_SORT, CELL_VALUES, CELL_GRADIENTS]
        .map(|text| parsed("cells", &with_imports(text)));
    assert_eq!(
        layout_in(&bin, "Sight"),
        layout_of!(SightData {
            right,
            right_offset,
            up,
            up_offset,
            forward,
            depth_offset,
            eye,
            scale,
            middle,
            least_depth,
            keys_per_depth,
            num_points,
            num_cuts,
            num_faces,
            is_perspective,
            num_columns,
            num_rows,
            tiles_across,
            first_tile_row,
            num_tile_rows,
            per_half_longest,
            first_row,
            num_all_faces,
        })
    );
    assert_eq!(layout_in(&scan, "Scan"), layout_of!(ScanData { num, part }));
    assert_eq!(layout_in(&sort, "Digit"), layout_of!(DigitData { num, shift, part, num_parts }));
    assert_eq!(
        layout_in(&values, "Values"),
        layout_of!(ValuesData { first, rest, factor, offset, payload, step, mask })
    );
    for module in [&values, &gradients] {
        assert_eq!(layout_in(module, "Cut"), layout_of!(CutData { ends, weight }));
    }
}

#[test]
fn every_file_is_used() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src/gpu/shaders/shared");
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .map(|file| format!("shared/{}", file.unwrap().file_name().to_string_lossy()))
        .collect();
    files.sort();
    assert_eq!(files, SHARED.iter().map(|(name, _)| *name).collect::<Vec<_>>());
}

#[test]
fn structs_are_laid_out_alike() {
    let (decode, raycast) =
        (parsed("decode", &with_imports(DECODE)), parsed("raycast", &with_imports(RAYCAST)));
    assert_eq!(
        layout_in(&raycast, "Lighting"),
        layout_of!(LightingData {
            world_from_difference,
            unit_from_step,
            ambient,
            diffuse,
            specular,
            specular_power,
        })
    );
    assert_eq!(
        layout_in(&raycast, "View"),
        layout_of!(ViewData {
            start,
            cell_edge,
            start_per_column,
            root_level,
            start_per_row,
            first_row,
            direction,
            num_columns,
            direction_per_column,
            num_rows,
            direction_per_row,
            is_first,
            step_per_direction,
            most_place,
            last,
            full_edge,
            cells,
            low_apron,
            per_texel,
            lighting,
        })
    );
    assert_eq!(
        layout_in(&raycast, "Brick"),
        layout_of!(BrickData {
            origin,
            scale,
            texel,
            colors,
            index_from_texel,
            mask,
            payload,
            step,
            later,
            later_step,
            later_weight,
        })
    );
    assert_eq!(layout_in(&raycast, "Constant"), layout_of!(ConstantData { color, log_transmittance, scale }));
    assert_eq!(
        layout_in(&decode, "Batch"),
        layout_of!(BatchData { full_edge, pairs, slots_along, row_words, first_line, first_job })
    );
    assert_eq!(layout_in(&decode, "Job"), layout_of!(JobData { slot, step }));
}

#[test]
fn structs_of_slices_are_laid_out_alike() {
    let slices = parsed("slices", &with_imports(SLICES));
    assert_eq!(
        layout_in(&slices, "Planes"),
        layout_of!(PlanesData {
            column,
            column_offset,
            row,
            row_offset,
            column_per_depth,
            row_per_depth,
            start,
            is_perspective,
        })
    );
    assert_eq!(layout_in(&slices, "Box"), layout_of!(BoxData { low, content, high }));
}

#[test]
fn stages_are_described_in_as_many_words_as_the_shader_reads() {
    let text = SHARED.iter().find(|(name, _)| *name == "shared/decode.wgsl").unwrap().1;
    assert!(text.contains(&format!("const STAGE_WORDS: u32 = {}u;", size_of::<StageData>() / 4)));
}
