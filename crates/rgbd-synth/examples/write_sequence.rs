//! Writes a synthetic sequence to a folder: `write_sequence FOLDER [demo|tiny]`.
#![allow(clippy::print_stdout)]

use rgbd_synth::{Sequence, write_custom};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder = arguments.next().unwrap_or_else(|| "tiny-sequence".into());
    let sequence = match arguments.next().as_deref() {
        Some("demo") => Sequence::demo(),
        _ => Sequence::tiny(),
    };
    let start = std::time::Instant::now();
    write_custom(&sequence, &folder)?;
    println!("{}: {} frames in {folder}, {:.1?}", sequence.name(), sequence.len(), start.elapsed());
    for index in (0..sequence.len()).step_by(10) {
        let pose = sequence.cam_from_obj(index);
        let hidden = 100.0 * sequence.occlusion(index);
        println!("frame {index:3}: {:.3} m away, {hidden:.0} % hidden", pose.translation.z);
    }
    Ok(())
}
