//! The GPU engine: the whole training step in WGSL kernels through wgpu, nothing read back inside a round.
//!
//! The kernels are the files of `shaders/`; `docs/gpu.md` of the repository tells what runs where.

#[cfg(feature = "gpu")]
mod buffers;
#[cfg(feature = "gpu")]
mod device;
mod kernels;
#[cfg(feature = "gpu")]
mod layout;
#[cfg(all(test, feature = "gpu"))]
mod parity;
#[cfg(feature = "gpu")]
mod program;
#[cfg(feature = "gpu")]
mod round;
#[cfg(test)]
mod shaders;
#[cfg(feature = "gpu")]
mod upload;

#[cfg(feature = "gpu")]
pub use device::Gpu;
#[cfg(feature = "gpu")]
pub use round::GpuRound;
