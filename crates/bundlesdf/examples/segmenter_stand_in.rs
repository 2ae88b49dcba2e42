//! A small segmenter for `bundlesdf run --segmenter "command:PROGRAM"`: the pixels next to the last mask that have about
//! its mean depth. It stands in for a network in the tests of the protocol, where `--fail HOW` makes it misbehave.

use std::io::{BufReader, Write};
use std::time::Duration;

use mask_tracker::pipe::{Reply, Request, read_request, write_reply};
use rgbd_io::{Image, Mask, RgbdFrame};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let fail = match arguments.as_slice() {
        [flag, how] if flag == "--fail" => Some(how.as_str()),
        _ => None,
    };
    let mut from = BufReader::new(std::io::stdin().lock());
    let mut to = std::io::stdout().lock();
    let mut last = Mask::default();
    let mut frames = 0;
    while let Some(request) = read_request(&mut from)? {
        last = match request {
            Request::Start(_, mask) => mask,
            Request::Frame(frame) => {
                frames += 1;
                similar_depth(&frame, &last)
            }
        };
        match fail.filter(|_| frames == 3) {
            Some("crash") => return Err("as asked".into()),
            Some("garbage") => to.write_all(b"loading weights ...\n")?,
            Some("hang") => std::thread::sleep(Duration::from_secs(60)),
            Some("half") => to.write_all(b"{\"masks\":1,\"width\":640,\"height\":480}\n123")?,
            _ => {
                // Half the size, which the protocol allows.
                let mask = Image::from_fn(last.width() / 2, last.height() / 2, |x, y| last[(2 * x, 2 * y)]);
                write_reply(&mut to, &Reply { mask, confidence: 0.9 })?;
            }
        }
        if fail == Some("half") && frames == 3 {
            return Ok(());
        }
        to.flush()?;
    }
    Ok(())
}

fn similar_depth(frame: &RgbdFrame, last: &Mask) -> Mask {
    let depths: Vec<f32> = last
        .pixels()
        .iter()
        .zip(frame.depth.pixels())
        .filter_map(|(m, z)| (*m != 0 && *z > 0.0).then_some(*z))
        .collect();
    let mean = depths.iter().sum::<f32>() / depths.len().max(1) as f32;
    const REACH: usize = 6;
    Image::from_fn(last.width(), last.height(), |x, y| {
        let near = [
            (x, y),
            (x + REACH, y),
            (x.saturating_sub(REACH), y),
            (x, y + REACH),
            (x, y.saturating_sub(REACH)),
        ];
        let beside = near.iter().any(|&(u, v)| last.get(u, v).is_some_and(|m| *m != 0));
        u8::from(beside && (frame.depth[(x, y)] - mean).abs() < 0.1) * 255
    })
}
