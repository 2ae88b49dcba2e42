//! Files of weights: their bytes, and networks made of tensors that do not fit.

use crate::bytes::Bytes;
use matcher::learned::{self, EdgePoint2, LearnedOptions, Network, Weights, XFeat};
use rgbd_io::Image;

/// Safetensors and PyTorch archives.
pub(crate) fn run_files(data: &[u8]) {
    let Ok(weights) = Weights::from_bytes(data) else { return };
    for (_, tensor) in weights.iter() {
        assert_eq!(tensor.values.len(), tensor.shape.iter().product::<usize>());
    }
    for network in [None, Some(Network::EdgePoint2), Some(Network::XFeat)] {
        let _ = learned::from_bytes(network, data);
    }
}

/// A layer: its name and the shape that makes a working network with the others.
type Layer = (&'static str, [u8; 4]);

const EDGEPOINT2: [Layer; 17] = [
    ("block1.0", [2, 1, 4, 4]),
    ("block1.1", [2, 2, 3, 3]),
    ("block1.2.layer.0", [2, 2, 3, 3]),
    ("block1.2.layer.3", [2, 2, 3, 3]),
    ("block2.layer.0", [2, 2, 3, 3]),
    ("block2.layer.3", [3, 2, 3, 3]),
    ("block2.skip", [3, 2, 1, 1]),
    ("block3.layer.0", [3, 3, 3, 3]),
    ("block3.layer.3", [3, 3, 3, 3]),
    ("desc_head.0", [4, 8, 1, 1]),
    ("desc_head.1", [4, 2, 3, 3]),
    ("desc_head.2", [4, 4, 1, 1]),
    ("conv1", [2, 2, 1, 1]),
    ("conv2", [2, 3, 1, 1]),
    ("conv3", [2, 3, 1, 1]),
    ("score_head.0", [2, 2, 3, 3]),
    ("score_head.2", [2, 2, 3, 3]),
];
const EDGEPOINT2_LAST: Layer = ("score_head.4", [4, 2, 3, 3]);

const XFEAT: [Layer; 24] = [
    ("skip1.1", [2, 1, 1, 1]),
    ("block1.0", [2, 1, 3, 3]),
    ("block1.1", [2, 2, 3, 3]),
    ("block1.2", [2, 2, 3, 3]),
    ("block1.3", [2, 2, 3, 3]),
    ("block2.0", [2, 2, 3, 3]),
    ("block2.1", [2, 2, 3, 3]),
    ("block3.0", [4, 2, 3, 3]),
    ("block3.1", [4, 4, 3, 3]),
    ("block3.2", [4, 4, 1, 1]),
    ("block4.0", [4, 4, 3, 3]),
    ("block4.1", [4, 4, 3, 3]),
    ("block4.2", [4, 4, 3, 3]),
    ("block5.0", [2, 4, 3, 3]),
    ("block5.1", [2, 2, 3, 3]),
    ("block5.2", [2, 2, 3, 3]),
    ("block5.3", [4, 2, 1, 1]),
    ("block_fusion.0", [4, 4, 3, 3]),
    ("block_fusion.1", [4, 4, 3, 3]),
    ("block_fusion.2", [4, 4, 1, 1]),
    ("heatmap_head.0", [2, 4, 1, 1]),
    ("heatmap_head.1", [2, 2, 1, 1]),
    ("heatmap_head.2", [1, 2, 1, 1]),
    ("keypoint_head.0", [2, 64, 1, 1]),
];
const XFEAT_LAST: [Layer; 3] = [
    ("keypoint_head.1", [2, 2, 1, 1]),
    ("keypoint_head.2", [2, 2, 1, 1]),
    ("keypoint_head.3", [65, 2, 1, 1]),
];

/// Values that networks get; the odd ones are rare.
const VALUES: [f32; 16] =
    [0.0, 0.1, -0.1, 0.5, -0.5, 1.0, -1.0, 2.0, 0.05, -0.2, 1e-3, 3.0, 1e38, -1e38, 1e-40, f32::NAN];

/// The first byte chooses the network; then each layer takes a byte or more: its width or a mutation, and values.
pub(crate) fn run_networks(data: &[u8]) {
    let mut bytes = Bytes(data);
    let is_edgepoint2 = bytes.byte() & 1 == 0;
    let layers: Vec<Layer> = if is_edgepoint2 {
        EDGEPOINT2.into_iter().chain([EDGEPOINT2_LAST]).collect()
    } else {
        XFEAT.into_iter().chain(XFEAT_LAST).collect()
    };
    let (mut header, mut values) = (String::from("{"), Vec::new());
    for (name, shape) in layers {
        layer(&mut bytes, name, shape, &mut header, &mut values);
    }
    header.push('}');
    let mut file = (header.len() as u64).to_le_bytes().to_vec();
    file.extend(header.as_bytes());
    file.extend(values.iter().flat_map(|v: &f32| v.to_le_bytes()));
    let weights = Weights::from_bytes(&file);
    assert!(weights.is_ok(), "{weights:?}");
    let Ok(weights) = weights else { return };
    let (width, height) = (1 + bytes.below(40), 1 + bytes.below(40));
    let scale = bytes.choice(&[1.0, 255.0, 0.0, f32::NAN, f32::INFINITY, 1e38], 1.0);
    let gray = Image::from_fn(width, height, |x, y| scale * ((x * 7 + y * 13) % 17) as f32 / 17.0);
    let options = LearnedOptions { max_features: 50, ..LearnedOptions::default() };
    if is_edgepoint2 {
        let Ok(network) = EdgePoint2::new(&weights, options) else { return };
        network.maps(&gray);
        detect(&network, &gray);
    } else {
        let Ok(network) = XFeat::new(&weights, options) else { return };
        network.maps(&gray);
        detect(&network, &gray);
    }
}

fn detect(network: &dyn matcher::FeatureMatcher, gray: &Image<f32>) {
    let mask = Image::filled(gray.width(), gray.height(), 255);
    let options = matcher::CropOptions { side: 64, ..matcher::CropOptions::default() };
    let Some(crop) = matcher::RollCrop::new(gray, &mask, 0.3, &options) else { return };
    let features = network.detect(&crop);
    network.match_features(&features, &features);
}

/// Appends one layer; a byte below 224 leaves its shape alone.
fn layer(bytes: &mut Bytes<'_>, name: &str, shape: [u8; 4], header: &mut String, values: &mut Vec<f32>) {
    let mut shape = shape.map(usize::from);
    let mutation = bytes.byte();
    match mutation {
        224..=239 => {
            if let Some(length) = shape.get_mut(bytes.below(4)) {
                *length = bytes.below(9);
            }
        }
        240..=247 => shape = [bytes.below(9), bytes.below(9), 3, 3],
        248..=255 => return,
        _ => {}
    }
    let count: usize = shape.iter().product();
    let (first, second) = (bytes.choice(&VALUES, 0.0), bytes.choice(&VALUES, 0.0));
    let comma = if header.len() > 1 { "," } else { "" };
    let from = 4 * values.len();
    values.extend((0..count).map(|i| if i % 3 == 1 { second } else { first }));
    *header += &format!(
        r#"{comma}"{name}.weight":{{"dtype":"F32","shape":{shape:?},"data_offsets":[{from},{}]}}"#,
        from + 4 * count
    );
    if mutation & 1 == 1 {
        let outputs = shape.first().copied().unwrap_or(0) + usize::from(mutation == 223);
        let from = 4 * values.len();
        values.extend(std::iter::repeat_n(second, outputs));
        *header += &format!(
            r#","{name}.bias":{{"dtype":"F32","shape":[{outputs}],"data_offsets":[{from},{}]}}"#,
            from + 4 * outputs
        );
    }
}
