//! Lists the sequences of a dataset with what is known about them:
//! `cargo run --features datasets --example sequences -- ho3d FOLDER`.
#![allow(clippy::print_stdout)]

use rgbd_io::FrameSource;
use rgbd_io::datasets::{Dataset, DatasetOptions};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let names: Vec<&str> = Dataset::ALL.iter().map(|d| d.name()).collect();
    let mut arguments = std::env::args().skip(1);
    let (Some(dataset), Some(root)) = (arguments.next(), arguments.next()) else {
        println!("usage: sequences {} FOLDER", names.join("|"));
        return Ok(());
    };
    let dataset =
        Dataset::from_name(&dataset).ok_or_else(|| format!("the dataset is one of {}", names.join(", ")))?;
    for name in dataset.sequences(&root)? {
        let line = dataset.open(&root, &name, &DatasetOptions::default()).and_then(|sequence| {
            let ((width, height), truth) = (sequence.size(), sequence.truth()?);
            let known = truth.cam_from_obj.iter().flatten().count();
            let model = truth.model.map_or_else(|| "no model".to_owned(), |m| m.display().to_string());
            Ok(format!("{} frames of {width}x{height}, {known} with a pose, {model}", sequence.len()))
        });
        println!("{name}: {}", line.unwrap_or_else(|e| e.to_string()));
    }
    Ok(())
}
