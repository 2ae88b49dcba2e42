//! Matches and tracks two procedural views of one object and says how right and how fast that was:
//! `cargo run --release -p bundlesdf-matcher --example match_pair`.
#![allow(clippy::print_stdout, unreachable_pub)]

#[path = "../tests/texture/mod.rs"]
mod texture;

use matcher::{
    CornerOptions, CropOptions, FeatureMatcher, KltOptions, LiftedMatch, Pyramid, RansacOptions, Rect,
    RollCrop, ScaleSpaceMatcher, detect_corners, ransac, track_forward_backward,
};
use rgbd_io::{Image, Mask};
use std::time::Instant;
use texture::texture;

const SIZE: (usize, usize) = (640, 480);
/// The second view is rolled and moved.
const ROLL: f32 = 0.5;
const SHIFT: [f32; 2] = [14.0, -9.0];

/// Where pixel `p` of the first view went.
fn moved(p: [f32; 2]) -> [f32; 2] {
    let (s, c) = ROLL.sin_cos();
    let (u, v) = (p[0] - 320.0, p[1] - 240.0);
    [c * u - s * v + 320.0 + SHIFT[0], s * u + c * v + 240.0 + SHIFT[1]]
}

/// The pixel of the first view that went to `p`.
fn origin(p: [f32; 2]) -> [f32; 2] {
    let (s, c) = ROLL.sin_cos();
    let (u, v) = (p[0] - 320.0 - SHIFT[0], p[1] - 240.0 - SHIFT[1]);
    [c * u + s * v + 320.0, -s * u + c * v + 240.0]
}

/// An object of 250 x 200 pixels in front of a background that stays.
fn view(map: impl Fn([f32; 2]) -> [f32; 2]) -> (Image<f32>, Mask) {
    let mut mask = Mask::filled(SIZE.0, SIZE.1, 0);
    let gray = Image::from_fn(SIZE.0, SIZE.1, |x, y| {
        let p = map([x as f32, y as f32]);
        if ((p[0] - 320.0) / 125.0).powi(2) + ((p[1] - 240.0) / 100.0).powi(2) <= 1.0 {
            mask[(x, y)] = 255;
            texture(p[0], p[1], 1)
        } else {
            texture(x as f32, y as f32, 2)
        }
    });
    (gray, mask)
}

/// Fastest of some runs, milliseconds.
fn timed<T>(mut f: impl FnMut() -> T) -> (T, f64) {
    let mut times = Vec::new();
    loop {
        let start = Instant::now();
        let result = f();
        times.push(start.elapsed().as_secs_f64() * 1e3);
        if times.len() == 40 {
            times.sort_by(f64::total_cmp);
            return (result, times[0]);
        }
    }
}

fn report(what: &str, pairs: &[([f32; 2], [f32; 2])], ms: f64) {
    let error = |(a, b): &([f32; 2], [f32; 2])| {
        let truth = moved(*a);
        (b[0] - truth[0]).hypot(b[1] - truth[1])
    };
    let mut errors: Vec<f32> = pairs.iter().map(error).collect();
    errors.sort_by(f32::total_cmp);
    let good = errors.iter().filter(|e| **e < 2.0).count();
    let median = errors.get(errors.len() / 2).copied().unwrap_or(f32::NAN);
    println!("{what}: {} pairs, {good} within 2 px, median error {median:.3} px, {ms:.2} ms", pairs.len());
}

fn main() -> Result<(), &'static str> {
    let ((gray_a, mask_a), (gray_b, mask_b)) = (view(|p| p), view(origin));
    let options = CropOptions::default();
    let (crop, crop_ms) = timed(|| RollCrop::new(&gray_a, &mask_a, 0.0, &options));
    let crop_a = crop.ok_or("the object is empty")?;
    let crop_b = RollCrop::new(&gray_b, &mask_b, f64::from(-ROLL), &options).ok_or("the object is empty")?;
    println!("crop: {:?} pixels, {crop_ms:.2} ms", crop_a.gray().size());

    let matcher = ScaleSpaceMatcher::default();
    let (a, detect_ms) = timed(|| matcher.detect(&crop_a));
    let b = matcher.detect(&crop_b);
    println!("detect and describe: {} and {} features, {detect_ms:.2} ms", a.len(), b.len());
    let (matches, match_ms) = timed(|| matcher.match_features(&a, &b));
    report("match", &matches.iter().map(|m| (m.a, m.b)).collect::<Vec<_>>(), match_ms);

    let (corners, corner_ms) = timed(|| detect_corners(&gray_a, &mask_a, &CornerOptions::default()));
    println!("corners: {}, {corner_ms:.2} ms", corners.len());
    let cut = |gray: &Image<f32>, mask: &Mask| {
        let rect = Rect::around_mask(mask, 20).ok_or("the object is empty")?;
        Ok::<_, &str>(Pyramid::new(rect.cut(gray), 3).with_origin([rect.x as f32, rect.y as f32]))
    };
    // The pose's prediction is off by 3 pixels and 3 degrees.
    let guesses: Vec<_> = corners.iter().map(|&p| moved(p)).map(|q| [q[0] + 2.0, q[1] - 2.0]).collect();
    let (s, c) = (ROLL - 0.05).sin_cos();
    let warps = vec![[c, -s, s, c]; corners.len()];
    let (tracks, track_ms) = timed(|| {
        let (a, b) = (cut(&gray_a, &mask_a)?, cut(&gray_b, &mask_b)?);
        Ok::<_, &str>(track_forward_backward(
            &a,
            &b,
            &corners,
            &guesses,
            Some(&warps),
            &KltOptions::default(),
        ))
    });
    let pairs: Vec<_> = corners.iter().zip(tracks?).filter_map(|(&p, t)| Some((p, t?.position))).collect();
    report("pyramids and tracks", &pairs, track_ms);

    // The matches lifted to a plane one metre away, 0.5 mm a pixel; every second one is given a wrong partner.
    let lift = |p: [f32; 2]| [(p[0] - 320.0) * 5e-4, (p[1] - 240.0) * 5e-4, 0.0];
    let normal = [0.0, 0.0, -1.0];
    let lifted: Vec<LiftedMatch> = (0..matches.len())
        .map(|i| {
            let partner = &matches[if i % 2 == 0 { i } else { (i * 7 + 3) % matches.len() }];
            let (a, b) = (lift(matches[i].a), lift(partner.b));
            LiftedMatch {
                a,
                normal_a: normal,
                b,
                normal_b: normal,
                sight: [0.0; 3],
                weight: matches[i].confidence,
            }
        })
        .collect();
    let (model, ransac_ms) = timed(|| ransac::estimate(&lifted, &RansacOptions::default()));
    let model = model.ok_or("no motion")?;
    println!(
        "ransac: {} of {} are inliers, roll {:.4} (true {ROLL}), {ransac_ms:.2} ms",
        model.inliers.len(),
        lifted.len(),
        model.motion.rotation.scaled_axis().z
    );
    Ok(())
}
