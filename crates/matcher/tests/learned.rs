//! The learned matchers: against a plain reference on random weights everywhere, and against what PyTorch computes
//! with the published weights where those are at hand.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    unreachable_pub,
    missing_docs
)]

#[path = "learned/reference.rs"]
mod reference;
mod texture;

use matcher::learned::{EdgePoint2, Error, LearnedOptions, Network, Tensor, Weights, XFeat, from_bytes};
use matcher::{CropOptions, Descriptors, FeatureMatcher, Match, RollCrop};
use reference::{Nodes, edgepoint2_shapes, random_weights, safetensors, xfeat_shapes};
use rgbd_io::{Image, Mask};
use std::path::PathBuf;
use texture::texture;

/// A file of the published weights, which are not part of this repository.
fn published(name: &str) -> Option<Vec<u8>> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/weights").join(name);
    let bytes = std::fs::read(&path).ok();
    if bytes.is_none() {
        println!("skipped: {name} is not at hand");
    }
    bytes
}

/// The input, 0 to `scale`, and the outputs. (The epsilon of the normalisation is in the units of the input.)
fn golden(scale: f32) -> Option<(Image<f32>, Weights)> {
    let png = image::load_from_memory(&published("golden_input_320x256.png")?).unwrap().to_rgb8();
    let (width, height) = png.dimensions();
    let gray = Image::from_fn(width as usize, height as usize, |x, y| {
        let sum: f32 = png.get_pixel(x as u32, y as u32).0.iter().map(|&v| f32::from(v)).sum();
        scale * sum / (3.0 * 255.0)
    });
    Some((gray, Weights::from_bytes(&published("golden_outputs.safetensors")?).unwrap()))
}

fn assert_close(got: &Tensor, want: &Tensor, tolerance: f32, what: &str) {
    assert_eq!(got.shape, want.shape, "{what}");
    let errors = got.values.iter().zip(&want.values).map(|(g, w)| (g - w).abs());
    let worst = errors.fold(0.0_f32, |m, e| if e.is_nan() { f32::INFINITY } else { m.max(e) });
    println!("{what}: largest difference {worst:.2e}");
    assert!(worst <= tolerance, "{what}: off by {worst}");
}

fn edgepoint2(bytes: &[u8]) -> EdgePoint2 {
    EdgePoint2::new(&Weights::from_bytes(bytes).unwrap(), LearnedOptions::default()).unwrap()
}

fn xfeat(bytes: &[u8]) -> XFeat {
    XFeat::new(&Weights::from_bytes(bytes).unwrap(), LearnedOptions::default()).unwrap()
}

#[test]
fn published_edgepoint2_computes_what_pytorch_does() {
    let Some((gray, golden)) = golden(1.0) else { return };
    for size in ["T32", "M64", "L64"] {
        let Some(folded) = published(&format!("edgepoint2_{size}_folded_f32.safetensors")) else { return };
        let Some(original) = published(&format!("edgepoint2_{size}.pth")) else { return };
        let (net, other) = (edgepoint2(&folded), edgepoint2(&original));
        assert_eq!(net.name(), format!("EdgePoint2-{size}"));
        assert_eq!(other.name(), net.name());
        let (maps, others) = (net.maps(&gray), other.maps(&gray));
        if let (Some(a), Some(b)) =
            (golden.get(&format!("edgepoint2_{size}.a")), golden.get(&format!("edgepoint2_{size}.b")))
        {
            assert_close(&maps.descriptors, a, 1e-3, &format!("{size} descriptors"));
            assert_close(&maps.scores, b, 1e-3, &format!("{size} scores"));
        }
        assert_close(&others.descriptors, &maps.descriptors, 1e-4, &format!("{size} descriptors, .pth"));
        assert_close(&others.scores, &maps.scores, 1e-4, &format!("{size} scores, .pth"));
    }
}

#[test]
fn published_xfeat_computes_what_pytorch_does() {
    let Some((gray, golden)) = golden(255.0) else { return };
    let Some(bytes) = published("xfeat_folded_f32.safetensors") else { return };
    let maps = xfeat(&bytes).maps(&gray);
    assert_close(&maps.features, golden.get("xfeat.feats").unwrap(), 1e-3, "features");
    assert_close(
        &maps.keypoint_logits,
        golden.get("xfeat.keypoint_logits").unwrap(),
        1e-3,
        "keypoint logits",
    );
    assert_close(&maps.reliability, golden.get("xfeat.reliability").unwrap(), 1e-3, "reliability");
}

/// A textured ellipse in front of another texture, and the same turned by `degrees`, half as far away again, and moved.
fn views(degrees: f32, contrast: f32) -> ([RollCrop; 2], impl Fn([f32; 2]) -> [f32; 2]) {
    let (s, c) = degrees.to_radians().sin_cos();
    let forward = move |p: [f32; 2]| {
        let (u, v) = (0.8 * (p[0] - 160.0), 0.8 * (p[1] - 130.0));
        [c * u - s * v + 167.3, s * u + c * v + 126.2]
    };
    let backward = move |p: [f32; 2]| {
        let (u, v) = ((p[0] - 167.3) / 0.8, (p[1] - 126.2) / 0.8);
        [c * u + s * v + 160.0, -s * u + c * v + 130.0]
    };
    let crop = |map: &dyn Fn([f32; 2]) -> [f32; 2]| {
        let mut mask = Mask::filled(320, 260, 0);
        let gray = Image::from_fn(320, 260, |x, y| {
            let p = map([x as f32, y as f32]);
            if ((p[0] - 160.0) / 95.0).powi(2) + ((p[1] - 130.0) / 75.0).powi(2) <= 1.0 {
                mask[(x, y)] = 255;
                128.0 + contrast * (texture(p[0], p[1], 21) - 128.0)
            } else {
                texture(x as f32, y as f32, 77)
            }
        });
        RollCrop::new(&gray, &mask, 0.0, &CropOptions::default()).unwrap()
    };
    ([crop(&|p| p), crop(&backward)], forward)
}

fn errors(matches: &[Match], truth: impl Fn([f32; 2]) -> [f32; 2]) -> Vec<f32> {
    let error = |m: &Match| {
        let t = truth(m.a);
        (m.b[0] - t[0]).hypot(m.b[1] - t[1])
    };
    let mut errors: Vec<f32> = matches.iter().map(error).collect();
    errors.sort_by(f32::total_cmp);
    errors
}

#[test]
fn published_networks_match_a_turned_view() {
    for (file, at_least) in [("edgepoint2_L64.pth", 60), ("xfeat_folded_f32.safetensors", 60)] {
        let Some(bytes) = published(file) else { return };
        let matcher = from_bytes(None, &bytes).unwrap();
        let ([a, b], truth) = views(14.0, 1.0);
        let matches = matcher.match_features(&matcher.detect(&a), &matcher.detect(&b));
        let errors = errors(&matches, truth);
        let good = errors.iter().filter(|e| **e < 3.0).count();
        println!("{file}: {good} of {} within 3 px, median {:.2}", errors.len(), errors[good / 2]);
        assert!(good >= at_least && 2 * good >= errors.len(), "{file}: {good} of {}", errors.len());
    }
}

fn test_image(width: usize, height: usize) -> Image<f32> {
    Image::from_fn(width, height, |x, y| texture(x as f32, y as f32, 3))
}

#[test]
fn edgepoint2_is_the_network_of_its_reference() {
    for sizes in [[8, 8, 16, 24, 32, 8], [8, 16, 32, 48, 64, 8]] {
        let weights = random_weights(&edgepoint2_shapes(sizes), 7);
        let net = edgepoint2(&safetensors(&weights));
        let gray = test_image(96, 64);
        let maps = net.maps(&gray);
        let nodes = Nodes { weights: &weights };
        let (descriptors, scores) = nodes.edgepoint2(&gray);
        assert_close(&maps.descriptors, &descriptors, 2e-4, "descriptors");
        assert_close(&maps.scores, &scores, 2e-4, "scores");
    }
}

#[test]
fn xfeat_is_the_network_of_its_reference() {
    let weights = random_weights(&xfeat_shapes(), 8);
    let net = xfeat(&safetensors(&weights));
    let gray = test_image(96, 64);
    let maps = net.maps(&gray);
    let (features, logits, reliability) = Nodes { weights: &weights }.xfeat(&gray);
    assert_close(&maps.features, &features, 2e-4, "features");
    assert_close(&maps.keypoint_logits, &logits, 2e-4, "logits");
    assert_close(&maps.reliability, &reliability, 2e-4, "reliability");
}

/// Matchers of random weights: their features are poor, but follow all the rules.
fn random_matchers() -> [Box<dyn FeatureMatcher>; 2] {
    let edge = safetensors(&random_weights(&edgepoint2_shapes([8, 8, 16, 24, 32, 8]), 1));
    let xfeat = safetensors(&random_weights(&xfeat_shapes(), 2));
    [from_bytes(None, &edge).unwrap(), from_bytes(Some(Network::XFeat), &xfeat).unwrap()]
}

#[test]
fn features_lie_on_the_object_whatever_the_number_of_threads() {
    let ([a, _], _) = views(0.0, 1.0);
    for (matcher, least) in random_matchers().into_iter().zip([20, 0]) {
        let features = matcher.detect(&a);
        let n = features.len();
        assert!(n >= least && n <= LearnedOptions::default().max_features, "{n} features");
        assert_eq!(features.scales.len(), n);
        let Descriptors::F32 { len, values } = &features.descriptors else { panic!("not floats") };
        assert_eq!(values.len(), n * len);
        for d in values.chunks_exact(*len) {
            assert!((d.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-3);
        }
        for p in &features.points {
            let at = a.to_crop(*p).map(|v| (v + 0.5) as usize);
            assert!(a.mask()[(at[0], at[1])] != 0, "{p:?} is background");
        }
        for threads in [1, 3] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            assert_eq!(pool.install(|| matcher.detect(&a)), features);
        }
        // Every feature is its own nearest neighbour.
        let matches = matcher.match_features(&features, &features);
        assert!(matches.iter().all(|m| m.a == m.b && m.confidence > 0.9 && m.confidence <= 1.0));
        assert!(matches.len() * 10 >= n * 9, "{} of {n}", matches.len());
    }
}

#[test]
fn tiny_and_broken_crops_are_fine() {
    let gray = test_image(30, 30);
    let one = Mask::from_fn(30, 30, |x, y| u8::from(x == 15 && y == 15));
    let full = Mask::filled(30, 30, 1);
    let options = CropOptions::default();
    let crops = [
        RollCrop::new(&gray, &one, 0.3, &CropOptions { margin: 0.0, ..options }).unwrap(),
        RollCrop::new(&gray, &one, 0.3, &options).unwrap(),
        RollCrop::new(&gray, &full, 0.0, &CropOptions { side: 3, ..options }).unwrap(),
        RollCrop::new(&Image::filled(30, 30, 7.0), &full, 0.0, &options).unwrap(),
    ];
    for matcher in random_matchers() {
        for crop in &crops {
            let features = matcher.detect(crop);
            assert!(features.points.as_flattened().iter().all(|v| v.is_finite()));
        }
        let broken = Image::filled(30, 30, f32::NAN);
        assert!(matcher.detect(&RollCrop::new(&broken, &full, 0.0, &options).unwrap()).is_empty());
    }
}

#[test]
fn wrong_files_are_told() {
    let xfeat = random_weights(&xfeat_shapes(), 2);
    let bytes = safetensors(&xfeat);
    let refused = |network, bytes: &[u8]| from_bytes(network, bytes).err().expect("an error");
    assert!(matches!(refused(Some(Network::EdgePoint2), &bytes), Error::Tensor { .. }));
    let some: Vec<_> = xfeat.iter().filter(|(name, _)| name.starts_with("block1")).cloned().collect();
    assert!(matches!(refused(None, &safetensors(&some)), Error::UnknownNetwork { count: 8 }));
    assert!(matches!(refused(None, b"<html>"), Error::UnknownFormat { .. }));
    let mut wrong = xfeat.clone();
    let tensor = wrong.iter_mut().find(|(name, _)| name == "block4.1.weight").unwrap();
    tensor.1.shape = vec![32, 128, 3, 3];
    let text = refused(None, &safetensors(&wrong)).to_string();
    assert!(text.contains("block4.1") && text.contains("XFeat"), "{text}");
    let mut broken = xfeat;
    broken.iter_mut().find(|(name, _)| name == "skip1.1.bias").unwrap().1.values[0] = f32::NAN;
    assert!(matches!(refused(None, &safetensors(&broken)), Error::Tensor { .. }));
}

#[test]
fn the_authors_layout_of_xfeat_is_folded() {
    let folded = random_weights(&xfeat_shapes(), 2);
    // A layer is a convolution without bias, then batch normalisation without gain; some convolutions stand alone.
    let alone = ["skip1.1.", "block_fusion.2.", "heatmap_head.2.", "keypoint_head.3."];
    let mut original =
        vec![("fine_matcher.0.weight".to_owned(), Tensor { shape: vec![1, 1], values: vec![0.0] })];
    for (name, tensor) in &folded {
        let (layer, what) = name.rsplit_once('.').unwrap();
        if alone.iter().any(|a| name.starts_with(a)) {
            original.push((name.clone(), tensor.clone()));
        } else if what == "weight" {
            original.push((format!("{layer}.layer.0.weight"), tensor.clone()));
        } else {
            let like = |f: fn(f32) -> f32| Tensor {
                shape: tensor.shape.clone(),
                values: tensor.values.iter().map(|v| f(*v)).collect(),
            };
            original.push((format!("{layer}.layer.1.running_mean"), like(|v| -v)));
            original.push((format!("{layer}.layer.1.running_var"), like(|_| 1.0 - 1e-5)));
        }
    }
    let gray = test_image(64, 32);
    let (a, b) = (xfeat(&safetensors(&folded)).maps(&gray), xfeat(&safetensors(&original)).maps(&gray));
    assert_close(&b.features, &a.features, 1e-4, "features");
    assert_close(&b.keypoint_logits, &a.keypoint_logits, 1e-4, "keypoint logits");
}
