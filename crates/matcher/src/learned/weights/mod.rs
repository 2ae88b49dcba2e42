//! Named tensors from a file's bytes: safetensors, and the archives that PyTorch writes.
//!
//! Nothing in a file is executed. The pickle inside a PyTorch archive is a program; the few instructions that a plain
//! state dict needs are interpreted here ([`pickle`]) and every other one is refused.

#![warn(clippy::indexing_slicing)]

mod bytes;
mod pickle;
mod safetensors;
mod zip;

use super::error::Error;
use super::nn::Conv;
use std::collections::BTreeMap;

/// Limits: far above any network read here, far below what could exhaust memory.
const MAX_TENSORS: usize = 4096;
const MAX_VALUES: usize = 1 << 26;
const MAX_DIMENSIONS: usize = 8;

/// Batch normalisation's epsilon, PyTorch's default, which both networks use.
const BATCH_NORM_EPSILON: f64 = 1e-5;

/// A tensor of 32-bit floats, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Length along each dimension.
    pub shape: Vec<usize>,
    /// As many values as the product of the lengths.
    pub values: Vec<f32>,
}

/// The named tensors of a file. Integer tensors (PyTorch's batch counters) are left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Weights {
    tensors: BTreeMap<String, Tensor>,
}

impl Weights {
    /// Reads the bytes of a safetensors file or of a PyTorch archive (`.pth`, `.pt`: a state dict saved by PyTorch 1.6
    /// or later), told apart by their content.
    ///
    /// # Errors
    /// Damaged files, other formats, numbers that are not 32-bit floats, and pickles that are more than a state dict.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, Error> {
        let tensors = if bytes.starts_with(b"PK\x03\x04") {
            pickle::state_dict(&zip::Archive::new(bytes)?)?
        } else if bytes.get(8) == Some(&b'{') {
            safetensors::parse(bytes)?
        } else {
            let start = bytes.iter().take(16).flat_map(|b| b.escape_ascii()).map(char::from).collect();
            return Err(Error::UnknownFormat { start });
        };
        Ok(Self { tensors })
    }

    /// The tensor of this name.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.tensors.get(name)
    }

    /// Number of tensors.
    pub fn len(&self) -> usize {
        self.tensors.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.tensors.is_empty()
    }

    /// All tensors by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.tensors.iter().map(|(name, tensor)| (name.as_str(), tensor))
    }

    /// Whether there is a convolution called `name`, with or without batch normalisation beside it.
    pub(crate) fn has_conv(&self, name: &str) -> bool {
        self.conv_name(name).is_some()
    }

    /// `name`, or the convolution inside the authors' layer of that name.
    fn conv_name(&self, name: &str) -> Option<String> {
        let names = [name.to_owned(), format!("{name}.layer.0")];
        names.into_iter().find(|n| self.tensors.contains_key(&format!("{n}.weight")))
    }

    /// The shape `[outputs, inputs of a group, kernel, kernel]` of convolution `name`.
    pub(crate) fn conv_shape(&self, name: &str, network: &'static str) -> Result<[usize; 4], Error> {
        let wrong = |problem: String| Error::Tensor { name: format!("{name}.weight"), problem, network };
        let full = self.conv_name(name).ok_or_else(|| wrong("is missing".into()))?;
        let tensor = self.tensors.get(&format!("{full}.weight")).ok_or_else(|| wrong("is missing".into()))?;
        // With a length of 0 the others may be anything, and memory would be taken for them.
        <[usize; 4]>::try_from(tensor.shape.as_slice())
            .ok()
            .filter(|shape| shape.iter().all(|length| *length > 0))
            .ok_or_else(|| wrong(format!("has shape {:?}", tensor.shape)))
    }

    /// Convolution `name` on `inputs` channels, with its batch normalisation folded in.
    ///
    /// `kernel` is what the network expects there.
    pub(crate) fn conv(
        &self,
        name: &str,
        inputs: usize,
        kernel: usize,
        stride: usize,
        network: &'static str,
    ) -> Result<Conv, Error> {
        let Folded { shape, weight, bias } = self.folded(name, kernel, network)?;
        Conv::new(inputs, shape, &weight, &bias, stride).ok_or_else(|| Error::Tensor {
            name: format!("{name}.weight"),
            problem: format!("has shape {shape:?}, which does not fit {inputs} inputs"),
            network,
        })
    }

    /// Weights and bias of convolution `name`, with its batch normalisation folded in.
    pub(crate) fn folded(&self, name: &str, kernel: usize, network: &'static str) -> Result<Folded, Error> {
        let shape = self.conv_shape(name, network)?;
        let [outputs, inputs, rows, columns] = shape;
        let full = self.conv_name(name).unwrap_or_default();
        let wrong = |name: &str, problem: String| Error::Tensor { name: name.into(), problem, network };
        let vector = |name: &str| -> Result<Option<&[f32]>, Error> {
            match self.tensors.get(name) {
                Some(t) if t.shape != [outputs] => {
                    Err(wrong(name, format!("has shape {:?} instead of [{outputs}]", t.shape)))
                }
                found => Ok(found.map(|t| t.values.as_slice())),
            }
        };
        let weight_name = format!("{full}.weight");
        if [rows, columns] != [kernel, kernel] {
            return Err(wrong(
                &weight_name,
                format!("has shape {shape:?} instead of a {kernel}x{kernel} kernel"),
            ));
        }
        let mut weight = self.tensors.get(&weight_name).map(|t| t.values.clone()).unwrap_or_default();
        let mut bias = vector(&format!("{full}.bias"))?.map_or_else(|| vec![0.0; outputs], <[f32]>::to_vec);

        let norm = following(&full);
        if let (Some(mean), Some(variance)) =
            (vector(&format!("{norm}.running_mean"))?, vector(&format!("{norm}.running_var"))?)
        {
            let (gamma, beta) = (vector(&format!("{norm}.weight"))?, vector(&format!("{norm}.bias"))?);
            let kernels = weight.chunks_mut((inputs * rows * columns).max(1));
            let statistics = mean.iter().zip(variance);
            for (o, ((kernel, bias), (mean, variance))) in kernels.zip(&mut bias).zip(statistics).enumerate()
            {
                let of_output = |values: Option<&[f32]>, default: f64| {
                    values.and_then(|v| v.get(o)).map_or(default, |v| f64::from(*v))
                };
                let gain = of_output(gamma, 1.0) / (f64::from(*variance) + BATCH_NORM_EPSILON).sqrt();
                kernel.iter_mut().for_each(|w| *w = (f64::from(*w) * gain) as f32);
                *bias = ((f64::from(*bias) - f64::from(*mean)) * gain + of_output(beta, 0.0)) as f32;
            }
        }
        if weight.iter().chain(&bias).any(|v| !v.is_finite()) {
            return Err(wrong(&weight_name, "or what belongs to it is not finite".into()));
        }
        Ok(Folded { shape, weight, bias })
    }
}

/// A convolution's numbers.
pub(crate) struct Folded {
    /// `[outputs, inputs of a group, kernel, kernel]`.
    pub(crate) shape: [usize; 4],
    /// Row-major in this shape.
    pub(crate) weight: Vec<f32>,
    /// One for each output.
    pub(crate) bias: Vec<f32>,
}

/// The name of the module after `name` in its list: `layer.0` to `layer.1`.
fn following(name: &str) -> String {
    match name.rsplit_once('.') {
        Some((list, index)) => {
            index.parse::<usize>().map_or_else(|_| String::new(), |i| format!("{list}.{}", i + 1))
        }
        None => String::new(),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    impl Weights {
        pub(crate) fn from_tensors(tensors: impl IntoIterator<Item = (String, Tensor)>) -> Self {
            Self { tensors: tensors.into_iter().collect() }
        }
    }

    #[test]
    fn web_pages_and_pointers_are_named() {
        for bytes in [&b"<!DOCTYPE html><html>"[..], b"version https://git-lfs", b"", b"\x80\x02}q"] {
            let error = Weights::from_bytes(bytes).unwrap_err();
            assert!(matches!(error, Error::UnknownFormat { .. }), "{error}");
        }
        let text = Weights::from_bytes(b"<!DOCTYPE html>").unwrap_err().to_string();
        assert!(text.contains("<!DOCTYPE") && text.contains("download"), "{text}");
    }

    #[test]
    fn batch_normalisation_is_folded() {
        let tensor =
            |shape: &[usize], values: &[f32]| Tensor { shape: shape.to_vec(), values: values.to_vec() };
        let weights = Weights::from_tensors([
            ("a.layer.0.weight".into(), tensor(&[1, 1, 1, 1], &[2.0])),
            ("a.layer.1.running_mean".into(), tensor(&[1], &[3.0])),
            ("a.layer.1.running_var".into(), tensor(&[1], &[4.0 - 1e-5])),
            ("a.layer.1.weight".into(), tensor(&[1], &[10.0])),
            ("a.layer.1.bias".into(), tensor(&[1], &[0.5])),
        ]);
        let conv = weights.conv("a", 1, 1, 1, "test").unwrap();
        let map = super::super::nn::Map::from_fn(1, 1, 1, |_, _, _| 7.0);
        // 10 * (2 * 7 - 3) / 2 + 0.5
        assert!((conv.run(&map, super::super::nn::After::Linear).at(0, 0, 0) - 55.5).abs() < 1e-4);
        // No outputs of so many inputs that memory for them ends.
        let none = Weights::from_tensors([("a.weight".into(), tensor(&[1 << 60, 0, 1, 1], &[]))]);
        assert!(matches!(none.conv("a", 1, 1, 1, "test"), Err(Error::Tensor { .. })));
        for (name, inputs, kernel) in [("b", 1, 1), ("a", 2, 1), ("a", 1, 3)] {
            assert!(matches!(weights.conv(name, inputs, kernel, 1, "test"), Err(Error::Tensor { .. })));
        }
    }
}
