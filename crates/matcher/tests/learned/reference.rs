//! The networks once more, as slowly and as plainly as they can be written, in 64 bits.

use matcher::learned::Tensor;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rgbd_io::Image;

pub type Named = Vec<(String, Tensor)>;

/// Names and shapes `[outputs, inputs of a group, kernel, kernel]` of the convolutions of EdgePoint2.
pub fn edgepoint2_shapes(
    [c1, c2, c3, c4, descriptor, detector]: [usize; 6],
) -> Vec<(&'static str, [usize; 4])> {
    let sum = c2 + c3 + c4;
    vec![
        ("block1.0.layer.0", [c1, 1, 4, 4]),
        ("block1.1.layer.0", [c2, c1, 3, 3]),
        ("block1.2.layer.0", [c2, c2, 3, 3]),
        ("block1.2.layer.3", [c2, c2, 3, 3]),
        ("block2.layer.0", [c3, c2, 3, 3]),
        ("block2.layer.3", [c3, c3, 3, 3]),
        ("block2.skip", [c3, c2, 1, 1]),
        ("block3.layer.0", [c4, c3, 3, 3]),
        ("block3.layer.3", [c4, c4, 3, 3]),
        ("block3.skip", [c4, c3, 1, 1]),
        ("desc_head.0", [sum, sum, 1, 1]),
        ("desc_head.1.layer.0", [sum, 16, 3, 3]),
        ("desc_head.2", [descriptor, sum, 1, 1]),
        ("conv1", [detector, c2, 1, 1]),
        ("conv2", [detector, c3, 1, 1]),
        ("conv3", [detector, c4, 1, 1]),
        ("score_head.0", [detector, detector, 3, 3]),
        ("score_head.2", [detector, detector, 3, 3]),
        ("score_head.4", [4, detector, 3, 3]),
    ]
}

/// The same of XFeat.
pub fn xfeat_shapes() -> Vec<(&'static str, [usize; 4])> {
    vec![
        ("skip1.1", [24, 1, 1, 1]),
        ("block1.0", [4, 1, 3, 3]),
        ("block1.1", [8, 4, 3, 3]),
        ("block1.2", [8, 8, 3, 3]),
        ("block1.3", [24, 8, 3, 3]),
        ("block2.0", [24, 24, 3, 3]),
        ("block2.1", [24, 24, 3, 3]),
        ("block3.0", [64, 24, 3, 3]),
        ("block3.1", [64, 64, 3, 3]),
        ("block3.2", [64, 64, 1, 1]),
        ("block4.0", [64, 64, 3, 3]),
        ("block4.1", [64, 64, 3, 3]),
        ("block4.2", [64, 64, 3, 3]),
        ("block5.0", [128, 64, 3, 3]),
        ("block5.1", [128, 128, 3, 3]),
        ("block5.2", [128, 128, 3, 3]),
        ("block5.3", [64, 128, 1, 1]),
        ("block_fusion.0", [64, 64, 3, 3]),
        ("block_fusion.1", [64, 64, 3, 3]),
        ("block_fusion.2", [64, 64, 1, 1]),
        ("heatmap_head.0", [64, 64, 1, 1]),
        ("heatmap_head.1", [64, 64, 1, 1]),
        ("heatmap_head.2", [1, 64, 1, 1]),
        ("keypoint_head.0", [64, 64, 1, 1]),
        ("keypoint_head.1", [64, 64, 1, 1]),
        ("keypoint_head.2", [64, 64, 1, 1]),
        ("keypoint_head.3", [65, 64, 1, 1]),
    ]
}

/// Uniform weights of variance `2 / inputs`, which keep the size of activations, and small biases.
pub fn random_weights(shapes: &[(&str, [usize; 4])], seed: u64) -> Named {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut tensors = Vec::new();
    for &(name, shape) in shapes {
        let inputs: usize = shape[1..].iter().product();
        let reach = (6.0 / inputs as f32).sqrt();
        let mut uniform =
            |n: usize, reach: f32| (0..n).map(|_| rng.random_range(-reach..reach)).collect::<Vec<f32>>();
        let (weight, bias) = (uniform(shape[0] * inputs, reach), uniform(shape[0], 0.1));
        tensors.push((format!("{name}.weight"), Tensor { shape: shape.to_vec(), values: weight }));
        tensors.push((format!("{name}.bias"), Tensor { shape: vec![shape[0]], values: bias }));
    }
    tensors
}

/// The bytes of a safetensors file.
pub fn safetensors(tensors: &[(String, Tensor)]) -> Vec<u8> {
    let (mut entries, mut data) = (Vec::new(), Vec::new());
    for (name, tensor) in tensors {
        let start = data.len();
        data.extend(tensor.values.iter().flat_map(|v| v.to_le_bytes()));
        let (shape, end) = (&tensor.shape, data.len());
        entries
            .push(format!(r#""{name}":{{"dtype":"F32","shape":{shape:?},"data_offsets":[{start},{end}]}}"#));
    }
    let header = format!("{{{}}}", entries.join(","));
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend_from_slice(header.as_bytes());
    bytes.extend(data);
    bytes
}

/// C x H x W.
#[derive(Clone)]
struct Map {
    size: [usize; 3],
    values: Vec<f64>,
}

impl Map {
    fn from_fn(size: [usize; 3], mut f: impl FnMut(usize, usize, usize) -> f64) -> Self {
        let mut values = Vec::new();
        for c in 0..size[0] {
            for y in 0..size[1] {
                for x in 0..size[2] {
                    values.push(f(c, y, x));
                }
            }
        }
        Self { size, values }
    }

    fn at(&self, c: usize, y: usize, x: usize) -> f64 {
        self.values[(c * self.size[1] + y) * self.size[2] + x]
    }

    fn tensor(&self) -> Tensor {
        Tensor { shape: self.size.to_vec(), values: self.values.iter().map(|v| *v as f32).collect() }
    }

    fn map(mut self, f: impl Fn(f64) -> f64) -> Self {
        self.values.iter_mut().for_each(|v| *v = f(*v));
        self
    }

    fn relu(self) -> Self {
        self.map(|v| v.max(0.0))
    }

    fn plus(mut self, other: &Self) -> Self {
        assert_eq!(self.size, other.size);
        self.values.iter_mut().zip(&other.values).for_each(|(a, b)| *a += b);
        self
    }

    fn pool(&self, n: usize) -> Self {
        let [c, h, w] = self.size;
        Self::from_fn([c, h / n, w / n], |c, y, x| {
            let block = (0..n * n).map(|i| self.at(c, y * n + i / n, x * n + i % n));
            block.sum::<f64>() / (n * n) as f64
        })
    }

    /// Bilinear, `align_corners = false`.
    fn up(&self, n: usize) -> Self {
        let [c, h, w] = self.size;
        let axis = |x: usize, size: usize| {
            let at = ((x as f64 + 0.5) / n as f64 - 0.5).clamp(0.0, size as f64 - 1.0);
            let first = at.floor() as usize;
            (first, (first + 1).min(size - 1), at - at.floor())
        };
        Self::from_fn([c, h * n, w * n], |c, y, x| {
            let ((y0, y1, fy), (x0, x1, fx)) = (axis(y, h), axis(x, w));
            let line = |y| self.at(c, y, x0) * (1.0 - fx) + self.at(c, y, x1) * fx;
            line(y0) * (1.0 - fy) + line(y1) * fy
        })
    }

    fn concat(maps: &[&Self]) -> Self {
        let [_, h, w] = maps[0].size;
        let values: Vec<f64> = maps.iter().flat_map(|m| m.values.clone()).collect();
        Self { size: [maps.iter().map(|m| m.size[0]).sum(), h, w], values }
    }
}

fn normalised(image: &Image<f32>) -> Map {
    let (w, h) = image.size();
    let map = Map::from_fn([1, h, w], |_, y, x| f64::from(image[(x, y)]));
    let n = map.values.len() as f64;
    let mean = map.values.iter().sum::<f64>() / n;
    let variance = map.values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    map.map(|v| (v - mean) / (variance + 1e-5).sqrt())
}

/// The layers by name.
pub struct Nodes<'a> {
    pub weights: &'a [(String, Tensor)],
}

impl Nodes<'_> {
    fn tensor(&self, name: &str) -> &Tensor {
        &self.weights.iter().find(|(n, _)| n == name).unwrap_or_else(|| panic!("no {name}")).1
    }

    fn conv(&self, name: &str, x: &Map, stride: usize) -> Map {
        let (weight, bias) = (self.tensor(&format!("{name}.weight")), self.tensor(&format!("{name}.bias")));
        let &[outputs, inputs, kernel, _] = weight.shape.as_slice() else {
            panic!("{name} is no convolution")
        };
        let pad = usize::from(kernel > 1);
        let [channels, h, w] = x.size;
        let group = outputs / (channels / inputs);
        let small = |n: usize| (n + 2 * pad - kernel) / stride + 1;
        Map::from_fn([outputs, small(h), small(w)], |o, y, u| {
            let mut sum = f64::from(bias.values[o]);
            for i in 0..inputs {
                for ky in 0..kernel {
                    for kx in 0..kernel {
                        let (row, column) = (y * stride + ky, u * stride + kx);
                        if row < pad || column < pad || row - pad >= h || column - pad >= w {
                            continue;
                        }
                        let value = weight.values[((o * inputs + i) * kernel + ky) * kernel + kx];
                        sum += f64::from(value) * x.at(o / group * inputs + i, row - pad, column - pad);
                    }
                }
            }
            sum
        })
    }

    fn residual(&self, name: &str, x: &Map, has_skip: bool) -> Map {
        let inner = self.conv(&format!("{name}.layer.0"), x, 1).relu();
        let skip = if has_skip { self.conv(&format!("{name}.skip"), x, 1) } else { x.clone() };
        self.conv(&format!("{name}.layer.3"), &inner, 1).plus(&skip).relu()
    }

    /// Descriptors and scores.
    pub fn edgepoint2(&self, image: &Image<f32>) -> (Tensor, Tensor) {
        let x = self.conv("block1.0.layer.0", &normalised(image), 2).relu();
        let x1 = self.residual("block1.2", &self.conv("block1.1.layer.0", &x, 1).relu(), false);
        let quarter = x1.pool(2);
        let x2 = self.residual("block2", &quarter.pool(2), true);
        let x3 = self.residual("block3", &x2.pool(4), true);
        let all = Map::concat(&[&quarter, &x2.up(2), &x3.up(8)]);
        let d = self.conv("desc_head.1.layer.0", &self.conv("desc_head.0", &all, 1), 1).relu();
        let descriptors = self.conv("desc_head.2", &d, 1);
        let s = self.conv("conv1", &x1, 1);
        let s = s.plus(&self.conv("conv2", &x2, 1).up(4)).plus(&self.conv("conv3", &x3, 1).up(16));
        let s = self.conv("score_head.2", &self.conv("score_head.0", &s, 1).relu(), 1).relu();
        let s = self.conv("score_head.4", &s, 1);
        let [_, h, w] = s.size;
        let scores = Map::from_fn([1, 2 * h, 2 * w], |_, y, x| s.at((y % 2) * 2 + x % 2, y / 2, x / 2));
        (descriptors.tensor(), scores.tensor())
    }

    fn chain(&self, x: &Map, names: &[(&str, usize)]) -> Map {
        names.iter().fold(x.clone(), |x, (name, stride)| self.conv(name, &x, *stride).relu())
    }

    /// Features, keypoint logits and reliability.
    pub fn xfeat(&self, image: &Image<f32>) -> (Tensor, Tensor, Tensor) {
        let input = normalised(image);
        let x1 = self.chain(&input, &[("block1.0", 1), ("block1.1", 2), ("block1.2", 1), ("block1.3", 2)]);
        let x1 = x1.plus(&self.conv("skip1.1", &input.pool(4), 1));
        let x2 = self.chain(&x1, &[("block2.0", 1), ("block2.1", 1)]);
        let x3 = self.chain(&x2, &[("block3.0", 2), ("block3.1", 1), ("block3.2", 1)]);
        let x4 = self.chain(&x3, &[("block4.0", 2), ("block4.1", 1), ("block4.2", 1)]);
        let x5 = self.chain(&x4, &[("block5.0", 2), ("block5.1", 1), ("block5.2", 1), ("block5.3", 1)]);
        let sum = x3.plus(&x4.up(2)).plus(&x5.up(4));
        let x = self.chain(&sum, &[("block_fusion.0", 1), ("block_fusion.1", 1)]);
        let features = self.conv("block_fusion.2", &x, 1);
        let x = self.chain(&features, &[("heatmap_head.0", 1), ("heatmap_head.1", 1)]);
        let reliability = self.conv("heatmap_head.2", &x, 1).map(|v| 1.0 / (1.0 + (-v).exp()));
        let [_, h, w] = input.size;
        let cells = Map::from_fn([64, h / 8, w / 8], |c, y, x| input.at(0, y * 8 + c / 8, x * 8 + c % 8));
        let x = self.chain(&cells, &[("keypoint_head.0", 1), ("keypoint_head.1", 1), ("keypoint_head.2", 1)]);
        let logits = self.conv("keypoint_head.3", &x, 1);
        (features.tensor(), logits.tensor(), reliability.tensor())
    }
}
