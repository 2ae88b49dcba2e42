//! An opened adapter with its compiled kernels, shared by all rounds.

use super::kernels::Kernel;
use crate::error::FieldError;
use std::fmt;
use std::future::Future;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::task::{Context, Poll, Waker};
use std::time::Duration;
use wgpu::util::DeviceExt;
use wgpu::{Backends, BufferUsages, DeviceType, Features};

/// Storage buffers that the largest kernels bind: what WebGPU guarantees.
const STORAGE_BUFFERS: u32 = 8;
/// Invocations of a workgroup.
pub(crate) const WORKGROUP: u32 = 64;
/// The longest that a callback may take to come once its work is done.
const CALLBACK: Duration = Duration::from_secs(10);

/// An opened GPU with the training step's kernels compiled for it. Cheap to clone; open it once and use it for every
/// round.
#[derive(Clone)]
pub struct Gpu {
    inner: Arc<Inner>,
}

struct Inner {
    device: wgpu::Device,
    queue: wgpu::Queue,
    name: String,
    software: bool,
    pipelines: Vec<wgpu::ComputePipeline>,
    /// The first thing that went wrong.
    failure: Failure,
}

type Failure = Arc<Mutex<Option<String>>>;

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Gpu").field(&self.inner.name).finish()
    }
}

impl Gpu {
    /// Opens the adapter that promises most: a discrete GPU before an integrated one before a software one.
    ///
    /// # Errors
    /// [`FieldError::Gpu`] when there is no adapter, or none with what the kernels need.
    pub fn open() -> Result<Self, FieldError> {
        Self::open_with(true)
    }

    /// As [`open`](Self::open); `float_atomics` false leaves atomic additions of floats unused even where the
    /// adapter has them.
    pub(crate) fn open_with(float_atomics: bool) -> Result<Self, FieldError> {
        let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
        descriptor.backends = Backends::PRIMARY;
        let instance = wgpu::Instance::new(descriptor);
        let adapters = now(instance.enumerate_adapters(Backends::PRIMARY)).unwrap_or_default();
        let adapter = adapters
            .into_iter()
            .min_by_key(|a| rank(a.get_info().device_type))
            .ok_or_else(|| fail("no adapter found: install a Vulkan, Metal or DirectX 12 driver"))?;
        let info = adapter.get_info();
        let limits = adapter.limits();
        if limits.max_storage_buffers_per_shader_stage < STORAGE_BUFFERS
            || limits.max_compute_invocations_per_workgroup < WORKGROUP
        {
            return Err(fail(&format!("{} has fewer storage buffers than the kernels need", info.name)));
        }
        let wanted = if float_atomics { Features::SHADER_FLOAT32_ATOMIC } else { Features::empty() };
        let features = adapter.features() & wanted;
        let request = wgpu::DeviceDescriptor {
            label: Some("neural-field"),
            required_features: features,
            required_limits: limits,
            ..Default::default()
        };
        let (device, queue) = now(adapter.request_device(&request))
            .ok_or_else(|| fail("the driver gave no device"))?
            .map_err(|e| fail(&format!("{}: {e}", info.name)))?;
        let name = format!("{} ({})", info.name, info.backend);
        Self::build(device, queue, name, info.device_type == DeviceType::Cpu)
    }

    fn build(
        device: wgpu::Device,
        queue: wgpu::Queue,
        name: String,
        software: bool,
    ) -> Result<Self, FieldError> {
        let failure = Failure::default();
        let first = failure.clone();
        device.on_uncaptured_error(Arc::new(move |error| note(&first, error.to_string())));
        let first = failure.clone();
        device.set_device_lost_callback(move |_, text| note(&first, format!("the device was lost ({text})")));
        let float_atomics = device.features().contains(Features::SHADER_FLOAT32_ATOMIC);
        let pipelines = Kernel::ALL.iter().map(|kernel| pipeline(&device, *kernel, float_atomics)).collect();
        let gpu = Self { inner: Arc::new(Inner { device, queue, name, software, pipelines, failure }) };
        gpu.check()?;
        Ok(gpu)
    }

    /// The adapter's name and interface.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.inner.name
    }

    /// Whether the adapter is a program on the CPU: right, but far slower than the CPU engine.
    #[must_use]
    pub fn is_software(&self) -> bool {
        self.inner.software
    }

    /// Whether the device has failed: every later round on it would fail, too.
    #[must_use]
    pub fn is_lost(&self) -> bool {
        self.check().is_err()
    }

    pub(crate) fn limits(&self) -> wgpu::Limits {
        self.inner.device.limits()
    }

    /// An error once anything has gone wrong on the device.
    pub(crate) fn check(&self) -> Result<(), FieldError> {
        match &*self.inner.failure.lock().unwrap_or_else(PoisonError::into_inner) {
            Some(text) => Err(fail(&format!("{}: {}", self.inner.name, text.trim()))),
            None => Ok(()),
        }
    }

    /// A buffer of zeros.
    pub(crate) fn zeros(&self, label: &str, bytes: u64) -> wgpu::Buffer {
        self.inner.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size: bytes,
            usage: BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST,
            mapped_at_creation: false,
        })
    }

    /// Collects failures of allocations until [`caught`](Self::caught).
    pub(crate) fn catch_out_of_memory(&self) -> wgpu::ErrorScopeGuard {
        self.inner.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory)
    }

    pub(crate) fn caught(&self, scope: wgpu::ErrorScopeGuard, text: &str) -> Result<(), FieldError> {
        match now(scope.pop()).flatten() {
            Some(_) => Err(fail(&format!("{}: {text}", self.inner.name))),
            None => Ok(()),
        }
    }

    pub(crate) fn write(&self, buffer: &wgpu::Buffer, bytes: &[u8]) {
        self.inner.queue.write_buffer(buffer, 0, bytes);
    }

    /// Binds a kernel's parameters and buffers, in the order of its bindings.
    pub(crate) fn bind(&self, kernel: Kernel, params: &[u32], buffers: &[&wgpu::Buffer]) -> wgpu::BindGroup {
        let device = &self.inner.device;
        let params = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some(kernel.name()),
            contents: bytemuck::cast_slice(params),
            usage: BufferUsages::UNIFORM,
        });
        let entries: Vec<_> = std::iter::once(&params)
            .chain(buffers.iter().copied())
            .zip(0..)
            .map(|(b, binding)| wgpu::BindGroupEntry { binding, resource: b.as_entire_binding() })
            .collect();
        device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(kernel.name()),
            layout: &self.pipeline(kernel).get_bind_group_layout(0),
            entries: &entries,
        })
    }

    fn pipeline(&self, kernel: Kernel) -> &wgpu::ComputePipeline {
        &self.inner.pipelines[kernel as usize]
    }

    /// Hands a list of dispatches to the device, without waiting for it.
    pub(crate) fn submit<'a>(&self, dispatches: impl Iterator<Item = &'a Dispatch>) -> wgpu::SubmissionIndex {
        let mut encoder = self.inner.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            for dispatch in dispatches {
                let [x, y, z] = dispatch.size;
                pass.set_pipeline(self.pipeline(dispatch.kernel));
                pass.set_bind_group(0, &dispatch.group, &[]);
                pass.dispatch_workgroups(x, y, z);
            }
        }
        self.inner.queue.submit([encoder.finish()])
    }

    /// Waits for a submission, or for all.
    pub(crate) fn wait(&self, submission: Option<wgpu::SubmissionIndex>) -> Result<(), FieldError> {
        let outcome =
            self.inner.device.poll(wgpu::PollType::Wait { submission_index: submission, timeout: None });
        if let Err(e) = outcome {
            note(&self.inner.failure, format!("the device does not answer ({e})"));
        }
        self.check()
    }

    /// The first `numbers` numbers of a buffer, after all that was submitted.
    pub(crate) fn read(&self, buffer: &wgpu::Buffer, numbers: usize) -> Result<Vec<f32>, FieldError> {
        let bytes = 4 * numbers as u64;
        if bytes == 0 {
            return Ok(Vec::new());
        }
        let device = &self.inner.device;
        let staging = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("staging"),
            size: bytes,
            usage: BufferUsages::MAP_READ | BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, bytes);
        self.inner.queue.submit([encoder.finish()]);
        let (sender, receiver) = mpsc::channel();
        staging.map_async(wgpu::MapMode::Read, .., move |outcome| {
            // Nobody listens any more when the wait below has failed.
            let _ = sender.send(outcome);
        });
        self.wait(None)?;
        // Another thread's wait may have taken this callback over and be just about to call it.
        let mapped = receiver.recv_timeout(CALLBACK).is_ok_and(|outcome| outcome.is_ok());
        let view = staging.get_mapped_range(..).ok().filter(|_| mapped);
        let view = view.ok_or_else(|| fail(&format!("{}: results can't be read", self.inner.name)))?;
        Ok(bytemuck::pod_collect_to_vec(&view))
    }

    /// Gives the device up, as if it had been lost.
    #[cfg(test)]
    pub(crate) fn lose(&self) {
        self.inner.device.destroy();
    }

    /// A device without a driver, which checks everything and computes nothing.
    #[cfg(test)]
    pub(crate) fn noop(float_atomics: bool) -> Result<Self, FieldError> {
        let wanted = if float_atomics { Features::SHADER_FLOAT32_ATOMIC } else { Features::empty() };
        let (device, queue) =
            wgpu::Device::noop(&wgpu::DeviceDescriptor { required_features: wanted, ..Default::default() });
        Self::build(device, queue, "noop".into(), true)
    }
}

/// One kernel on its data.
#[derive(Debug)]
pub(crate) struct Dispatch {
    pub(crate) kernel: Kernel,
    pub(crate) group: wgpu::BindGroup,
    /// Workgroups.
    pub(crate) size: [u32; 3],
}

fn pipeline(device: &wgpu::Device, kernel: Kernel, float_atomics: bool) -> wgpu::ComputePipeline {
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some(kernel.name()),
        source: wgpu::ShaderSource::Wgsl(kernel.source(float_atomics).into()),
    });
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(kernel.name()),
        layout: None,
        module: &module,
        entry_point: Some("main"),
        compilation_options: Default::default(),
        cache: None,
    })
}

fn rank(kind: DeviceType) -> u32 {
    match kind {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    }
}

pub(crate) fn fail(text: &str) -> FieldError {
    FieldError::Gpu(text.to_owned())
}

fn note(failure: &Failure, text: String) {
    failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(text);
}

/// The result of a future that needs no waiting, as all of wgpu's on native systems.
fn now<T>(future: impl Future<Output = T>) -> Option<T> {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => Some(value),
        Poll::Pending => None,
    }
}
