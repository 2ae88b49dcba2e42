//! Every kernel is valid WGSL within the capabilities that its variant may use, and every file is a kernel.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout, reason = "tests")]

use super::kernels::Kernel;
use naga::valid::{Capabilities, ValidationFlags, Validator};

fn problem(kernel: Kernel, float_atomics: bool) -> Result<(), String> {
    let source = kernel.source(float_atomics);
    let module = naga::front::wgsl::parse_str(&source).map_err(|e| e.emit_to_string(&source))?;
    let allowed = if float_atomics { Capabilities::SHADER_FLOAT32_ATOMIC } else { Capabilities::empty() };
    Validator::new(ValidationFlags::all(), allowed)
        .validate(&module)
        .map_err(|e| e.emit_to_string(&source))?;
    let [entry] = module.entry_points.as_slice() else { return Err("not one entry point".into()) };
    if entry.name != "main" || entry.workgroup_size.iter().product::<u32>() != 64 {
        return Err("the entry point is not `main` with 64 invocations".into());
    }
    let is_storage = |v: &naga::GlobalVariable| matches!(v.space, naga::AddressSpace::Storage { .. });
    let storage = module.global_variables.iter().filter(|(_, v)| is_storage(v)).count();
    if storage > 8 { Err(format!("WebGPU guarantees 8 storage buffers, not {storage}")) } else { Ok(()) }
}

#[test]
fn kernels_are_valid_with_and_without_atomic_floats() {
    let mut problems = String::new();
    for kernel in Kernel::ALL {
        for float_atomics in [false, true] {
            if let Err(text) = problem(kernel, float_atomics) {
                problems.push_str(&format!("{}: {text}\n", kernel.name()));
            }
        }
    }
    assert!(problems.is_empty(), "{problems}");
}

#[cfg(test)]
mod folder {
    use super::Kernel;

    #[test]
    fn every_file_is_a_kernel() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/shaders");
        let mut files: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .filter_map(|entry| entry.unwrap().file_name().into_string().ok())
            .filter_map(|name| name.strip_suffix(".wgsl").map(str::to_owned))
            .collect();
        files.sort();
        let mut kernels: Vec<String> = Kernel::ALL.iter().map(|k| k.name().to_owned()).collect();
        kernels.sort();
        assert_eq!(files, kernels);
        assert!(Kernel::ALL.iter().enumerate().all(|(i, k)| *k as usize == i));
    }
}
