//! The adapter, the device made of it, and how its loss is noticed.

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use super::passes::{PASSES, Pass};

/// A frame takes milliseconds; a device that is silent for so long will not answer.
const PATIENCE: Duration = Duration::from_secs(20);

/// Why a device cannot go on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lost(pub String);

/// Which adapters are taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Adapters {
    /// Graphics cards.
    Real,
    /// Software too, if there is nothing better.
    Any,
}

pub struct Device {
    pub device: wgpu::Device,
    pub queue: wgpu::Queue,
    pub adapter: String,
    pub pipelines: Vec<wgpu::ComputePipeline>,
    /// Whether passes can be timed.
    pub timed: bool,
    /// Whether stored halves are read by the card itself.
    pub half_precision: bool,
    /// The first thing that went wrong.
    failure: Arc<Mutex<Option<String>>>,
}

impl Device {
    /// `Ok(None)`: there is no such adapter.
    pub fn open(adapters: Adapters, half_precision: bool) -> Result<Option<Self>, Lost> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends: wgpu::Backends::PRIMARY,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let found = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
        let Some(adapter) = best(found, adapters) else {
            return Ok(None);
        };
        let info = adapter.get_info();
        let offered = adapter.limits();
        let mut wanted = wgpu::Features::TIMESTAMP_QUERY;
        wanted.set(wgpu::Features::SHADER_F16, half_precision);
        let features = adapter.features() & wanted;
        let timed = features.contains(wgpu::Features::TIMESTAMP_QUERY);
        let half_precision = features.contains(wgpu::Features::SHADER_F16);
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("surprised"),
            required_features: features,
            // Larger images where the card can; everything else fits what every card has.
            required_limits: wgpu::Limits {
                max_storage_buffer_binding_size: offered.max_storage_buffer_binding_size,
                max_buffer_size: offered.max_buffer_size,
                ..wgpu::Limits::default()
            },
            ..wgpu::DeviceDescriptor::default()
        }))
        .map_err(|error| Lost(format!("{} gives no device: {error}", info.name)))?;
        let failure = Arc::new(Mutex::new(None));
        let note = |failure: &Arc<Mutex<Option<String>>>| {
            let failure = Arc::clone(failure);
            move |message: String| {
                let mut failure = failure
                    .lock()
                    .unwrap_or_else(|poisoned| poisoned.into_inner());
                failure.get_or_insert(message);
            }
        };
        let lost = note(&failure);
        device.set_device_lost_callback(move |reason, message| {
            lost(format!("{reason:?}: {message}"));
        });
        let failed = note(&failure);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            failed(error.to_string())
        }));
        let device = Self {
            pipelines: PASSES
                .iter()
                .map(|pass| pipeline(&device, pass, half_precision))
                .collect(),
            adapter: format!("{} ({:?}, {:?})", info.name, info.device_type, info.backend),
            device,
            queue,
            timed,
            half_precision,
            failure,
        };
        device.check()?;
        Ok(Some(device))
    }

    /// The most that one buffer may hold, bytes.
    pub fn buffer_max(&self) -> u64 {
        let limits = self.device.limits();
        limits
            .max_storage_buffer_binding_size
            .min(limits.max_buffer_size)
    }

    pub fn buffer(&self, label: &str, bytes: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            // A binding must not be empty, a copy takes whole words.
            size: bytes.next_multiple_of(16).max(16),
            usage,
            mapped_at_creation: false,
        })
    }

    /// Uploads to the start of a word; the rest of the last word becomes 0.
    pub fn upload(&self, buffer: &wgpu::Buffer, offset: u64, bytes: &[u8]) {
        let (words, rest) = bytes.split_at(bytes.len() & !3);
        self.queue.write_buffer(buffer, offset, words);
        if !rest.is_empty() {
            let mut last = [0; 4];
            last[..rest.len()].copy_from_slice(rest);
            self.queue
                .write_buffer(buffer, offset + words.len() as u64, &last);
        }
    }

    /// The start of a buffer, when what was submitted is done.
    pub fn read(
        &self,
        buffer: &wgpu::Buffer,
        bytes: u64,
        after: wgpu::SubmissionIndex,
    ) -> Result<Vec<u8>, Lost> {
        self.check()?;
        let (sender, receiver) = std::sync::mpsc::channel();
        buffer.map_async(wgpu::MapMode::Read, ..bytes, move |result| {
            // Nobody listens any more only after the wait below has failed.
            let _ = sender.send(result);
        });
        self.device
            .poll(wgpu::PollType::Wait {
                submission_index: Some(after),
                timeout: Some(PATIENCE),
            })
            .map_err(|error| self.lost(&error.to_string()))?;
        self.check()?;
        // Another place's thread may be the one that calls back.
        match receiver.recv_timeout(PATIENCE) {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return Err(self.lost(&error.to_string())),
            Err(error) => return Err(self.lost(&error.to_string())),
        }
        let copy = buffer
            .get_mapped_range(..bytes)
            .map_err(|error| self.lost(&error.to_string()))?
            .to_vec();
        buffer.unmap();
        Ok(copy)
    }

    /// # Errors
    /// Once the device has failed.
    pub fn check(&self) -> Result<(), Lost> {
        let failure = self
            .failure
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        match &*failure {
            Some(message) => Err(Lost(message.clone())),
            None => Ok(()),
        }
    }

    fn lost(&self, otherwise: &str) -> Lost {
        self.check()
            .err()
            .unwrap_or_else(|| Lost(otherwise.to_owned()))
    }
}

/// The fastest kind that is there.
fn best(found: Vec<wgpu::Adapter>, adapters: Adapters) -> Option<wgpu::Adapter> {
    let rank = |adapter: &wgpu::Adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => Some(0),
        wgpu::DeviceType::IntegratedGpu => Some(1),
        wgpu::DeviceType::VirtualGpu => Some(2),
        wgpu::DeviceType::Other | wgpu::DeviceType::Cpu => (adapters == Adapters::Any).then_some(3),
    };
    found
        .into_iter()
        .filter_map(|adapter| Some((rank(&adapter)?, adapter)))
        .min_by_key(|(rank, _)| *rank)
        .map(|(_, adapter)| adapter)
}

fn pipeline(device: &wgpu::Device, pass: &Pass, half_precision: bool) -> wgpu::ComputePipeline {
    let native = pass.source_f16.filter(|_| half_precision);
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some(pass.label),
        source: wgpu::ShaderSource::Wgsl(native.unwrap_or(pass.source).into()),
    });
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(pass.label),
        layout: None,
        module: &module,
        entry_point: Some(pass.entry),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    })
}
