//! The shaders are valid, and agree with the Rust side about structs, bindings, workgroups and constants. No adapter is
//! needed.

use std::{collections::BTreeMap, path::Path};

use naga::{
    AddressSpace, Module, TypeInner,
    valid::{Capabilities, ModuleInfo, ValidationFlags, Validator},
};
use surprised::{
    engine::gpu::{
        layout::{Estimate, Exposure, Frame, Level, Rules, View},
        passes::{EXPOSE, EXPOSE_PIXELS, HISTOGRAM_WORDS, PASSES, Pass},
    },
    model::{belief::Record, viewpoint::VIEWS_MAX},
};

/// What every WebGPU device grants.
const STORAGE_BUFFERS_MAX: usize = 8;
const WORKGROUP_BYTES_MAX: u32 = 16 << 10;

fn validated(pass: &Pass) -> (Module, ModuleInfo) {
    valid(pass.label, pass.source, Capabilities::empty())
}

fn valid(label: &str, source: &str, capabilities: Capabilities) -> (Module, ModuleInfo) {
    let module = naga::front::wgsl::parse_str(source)
        .unwrap_or_else(|error| panic!("{label}: {}", error.emit_to_string(source)));
    let info = Validator::new(ValidationFlags::all(), capabilities)
        .validate(&module)
        .unwrap_or_else(|error| panic!("{label}: {}", error.emit_to_string(source)));
    (module, info)
}

#[test]
fn every_shader_is_valid_without_optional_features() {
    for pass in &PASSES {
        validated(pass);
    }
}

#[test]
fn half_precision_reads_what_is_stored_from_where_it_is() {
    let mut native = 0;
    for pass in &PASSES {
        let Some(source) = pass.source_f16 else {
            continue;
        };
        let half = Capabilities::SHADER_FLOAT16;
        let (module, _) = valid(pass.label, source, half);
        let (members, span) = layout_of(&module, "NativeRecord").expect("records are read");
        let offset = |name: &str| {
            let member = members.iter().find(|(member, _)| member == name);
            member.unwrap_or_else(|| panic!("no {name}")).1 as usize
        };
        assert_eq!(span as usize, size_of::<Record>());
        assert_eq!(offset("spread"), std::mem::offset_of!(Record, spread));
        assert_eq!(offset("sigma"), std::mem::offset_of!(Record, spread) + 8);
        assert_eq!(offset("level"), std::mem::offset_of!(Record, level));
        native += 1;
    }
    assert_eq!(native, 1);
}

#[test]
fn every_shader_file_is_part_of_a_pass() {
    let mut files = 0;
    for folder in ["shaders", "shaders/passes"] {
        for entry in std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)).unwrap()
        {
            let path = entry.unwrap().path();
            if path
                .extension()
                .is_some_and(|extension| extension == "wgsl")
            {
                let text = std::fs::read_to_string(&path).unwrap();
                assert!(
                    PASSES.iter().any(|pass| {
                        let native = pass.source_f16.unwrap_or_default();
                        pass.source.contains(&text) || native.contains(&text)
                    }),
                    "{path:?} belongs to no pass"
                );
                files += 1;
            }
        }
    }
    assert!(files >= 19, "only {files} shader files were found");
}

#[test]
fn entry_points_have_the_workgroups_and_bindings_of_the_table_of_passes() {
    for pass in &PASSES {
        let (module, info) = validated(pass);
        let (index, entry) = module
            .entry_points
            .iter()
            .enumerate()
            .find(|(_, entry)| entry.name == pass.entry)
            .unwrap_or_else(|| panic!("{} has no entry point {}", pass.label, pass.entry));
        assert_eq!(entry.workgroup_size, pass.workgroup, "{}", pass.label);
        let used = info.get_entry_point(index);
        let mut bindings = Vec::new();
        let (mut storage, mut workgroup_bytes) = (0, 0);
        for (handle, variable) in module.global_variables.iter() {
            if used[handle].is_empty() {
                continue;
            }
            match variable.space {
                AddressSpace::Storage { .. } => storage += 1,
                AddressSpace::WorkGroup => {
                    workgroup_bytes += module.types[variable.ty].inner.size(module.to_ctx());
                }
                _ => {}
            }
            if let Some(binding) = &variable.binding {
                assert_eq!(binding.group, 0);
                bindings.push((binding.binding, variable.name.clone().unwrap()));
            }
        }
        bindings.sort();
        let table: Vec<(u32, String)> = pass
            .bindings
            .iter()
            .map(|(binding, slot)| (*binding, slot.name().to_owned()))
            .collect();
        assert_eq!(bindings, table, "{}", pass.label);
        assert!(storage <= STORAGE_BUFFERS_MAX, "{}: {storage}", pass.label);
        assert!(workgroup_bytes <= WORKGROUP_BYTES_MAX, "{}", pass.label);
    }
}

/// Name and offset of every member, and the distance from one element of an array to the next.
fn layout_of(module: &Module, name: &str) -> Option<(Vec<(String, u32)>, u32)> {
    let (_, ty) = module
        .types
        .iter()
        .find(|(_, ty)| ty.name.as_deref() == Some(name))?;
    let TypeInner::Struct { members, span } = &ty.inner else {
        panic!("{name} is no struct");
    };
    let members = members
        .iter()
        .map(|member| (member.name.clone().unwrap(), member.offset))
        .collect();
    Some((members, *span))
}

macro_rules! layout {
    ($kind:ident { $($field:ident),* $(,)? }) => {
        (
            stringify!($kind),
            vec![$((stringify!($field).to_owned(), std::mem::offset_of!($kind, $field) as u32)),*],
            size_of::<$kind>() as u32,
        )
    };
}

#[test]
fn structs_have_the_same_fields_at_the_same_offsets() {
    let structs = [
        layout!(Frame {
            width,
            height,
            view_count,
            blocks_wide,
            blocks_high
        }),
        layout!(View {
            h_x,
            h_y,
            h_z,
            width,
            height,
            first,
            fresh,
            weight
        }),
        layout!(Rules {
            forgetting,
            xi,
            sigma_min,
            sigma_max,
            unseen_variance,
            edge_variance_px,
            surprise_threshold,
            depth_vote_tolerance,
            gamma_center,
            gamma_scale,
            second_look,
            starts_at_observation,
            depth_vote,
            colour_vote,
            view_variance,
            earlier_appearance,
            exposure_gain,
            gamma_coefficients,
        }),
        layout!(Exposure {
            gain,
            inverse_gain,
            seen
        }),
        layout!(Level {
            focal,
            center,
            certainty,
            width,
            height,
            first,
            index,
            finer_width,
            finer_first,
            image_width,
            inverse_discount,
            image_focal,
            image_center,
            position_sd_m,
            rotation_sd_rad,
        }),
        layout!(Estimate {
            rotation,
            translation,
            gain,
            mismatch,
            mismatch_before,
            offset,
            level_count,
            point_count,
            accepted,
        }),
    ];
    for (name, fields, size) in structs {
        let mut found = 0;
        for pass in &PASSES {
            let (module, _) = validated(pass);
            if let Some((members, span)) = layout_of(&module, name) {
                assert_eq!(members, fields, "{name} in {}", pass.label);
                assert_eq!(span, size, "{name} in {}", pass.label);
                found += 1;
            }
        }
        assert!(found > 0, "no shader has {name}");
    }
}

/// Every `const NAME: ... = value;` of a text whose value is a number, or a pair, as `NAME_LOW` and `NAME_HIGH`.
fn rust_constants(text: &str, found: &mut BTreeMap<String, Vec<f64>>) {
    let number = |text: &str| -> Option<f64> {
        let text = text.trim().replace('_', "");
        match text.split_once("<<") {
            Some((one, bits)) => Some(
                one.trim().parse::<f64>().ok()? * f64::powi(2.0, bits.trim().parse::<i32>().ok()?),
            ),
            None => text.parse().ok(),
        }
    };
    for line in text.lines().filter(|line| line.contains("const ")) {
        let Some((left, value)) = line.split_once('=') else {
            continue;
        };
        let Some((_, name)) = left.split_once("const ") else {
            continue;
        };
        let name = name.split(':').next().unwrap().trim();
        let value = value.trim().trim_end_matches(';');
        if let Some(value) = number(value) {
            found.entry(name.to_owned()).or_default().push(value);
        } else if let Some((low, high)) = value
            .trim_start_matches('(')
            .trim_end_matches(')')
            .split_once(',')
            && let (Some(low), Some(high)) = (number(low), number(high))
        {
            found.entry(format!("{name}_LOW")).or_default().push(low);
            found.entry(format!("{name}_HIGH")).or_default().push(high);
        }
    }
}

fn all_rust_constants() -> BTreeMap<String, Vec<f64>> {
    fn walk(folder: &Path, found: &mut BTreeMap<String, Vec<f64>>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                walk(&path, found);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                rust_constants(&std::fs::read_to_string(&path).unwrap(), found);
            }
        }
    }
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut found = BTreeMap::new();
    for folder in ["stages", "model", "engine"] {
        walk(&source.join(folder), &mut found);
    }
    rust_constants(
        &std::fs::read_to_string(source.join("lanes.rs")).unwrap(),
        &mut found,
    );
    // Not written as numbers there.
    found.insert("LN_2".into(), vec![std::f64::consts::LN_2]);
    found.insert("LOG2_E".into(), vec![std::f64::consts::LOG2_E]);
    found.insert("BIAS_SCALE".into(), vec![2f64.powi(112)]);
    found.insert("BIAS_SCALE_INVERSE".into(), vec![2f64.powi(-112)]);
    found.insert(
        "LEVEL_OFFSET_Y".into(),
        vec![surprised::model::belief::LEVEL_OFFSET[0].into()],
    );
    found.insert("PIXELS_PER_THREAD".into(), vec![EXPOSE_PIXELS.into()]);
    found.insert("THREADS".into(), vec![PASSES[EXPOSE].workgroup[0].into()]);
    found.insert("VIEWS_MAX".into(), vec![VIEWS_MAX as f64]);
    found.insert("BINS".into(), vec![(HISTOGRAM_WORDS - 1) as f64]);
    // What follows from others.
    let largest = found["SCALE_MAX"][0] / found["NORMAL_FROM_MEDIAN"][0];
    found.insert("MAGNITUDE_MAX".into(), vec![largest]);
    let first = (found["NEAR_M"][0] as f32).to_bits() >> 16;
    found.insert("DEPTH_BITS_FIRST".into(), vec![first.into()]);
    found.insert("DEPTH_BITS_SHIFT".into(), vec![16.0]);
    found
}

#[test]
fn every_constant_of_the_shaders_is_that_of_its_twin() {
    let rust = all_rust_constants();
    let mut compared = 0;
    for pass in &PASSES {
        let (module, _) = validated(pass);
        for (_, constant) in module.constants.iter() {
            let Some(name) = &constant.name else { continue };
            let naga::Expression::Literal(literal) = module.global_expressions[constant.init]
            else {
                panic!("{name} of {} is no number", pass.label);
            };
            let value = match literal {
                naga::Literal::F32(value) => f64::from(value),
                naga::Literal::U32(value) => f64::from(value),
                other => panic!("{name} is {other:?}"),
            };
            let twins = rust
                .get(name)
                .unwrap_or_else(|| panic!("{name} of {} has no twin", pass.label));
            for twin in twins {
                assert_eq!(*twin as f32, value as f32, "{name} of {}", pass.label);
            }
            compared += 1;
        }
    }
    assert!(compared > 40, "only {compared} constants were compared");
}
