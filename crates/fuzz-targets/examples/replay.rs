//! Gives files to a fuzz target: `replay TARGET FILE...`. A fault shows as a panic with a backtrace.
#![allow(clippy::print_stdout)]

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let names: Vec<&str> = fuzz_targets::TARGETS.iter().map(|target| target.name).collect();
    let Some(name) = arguments.next().filter(|name| names.contains(&name.as_str())) else {
        println!("give one of the targets {} and files", names.join(", "));
        return Ok(());
    };
    for path in arguments {
        let start = std::time::Instant::now();
        fuzz_targets::run(&name, &std::fs::read(&path)?);
        println!("{path}: {:.1} ms", start.elapsed().as_secs_f64() * 1e3);
    }
    Ok(())
}
