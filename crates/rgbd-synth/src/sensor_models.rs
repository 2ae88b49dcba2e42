//! Sensors from the literature.

use crate::Sensor;

impl Sensor {
    /// No fault at all: depth as exact as `f32` allows.
    pub fn perfect() -> Self {
        Self {
            depth_base: 0.0,
            depth_quadratic: 0.0,
            depth_grazing: 0.0,
            depth_amplitude: 0.0,
            correlated: 0.0,
            correlation: 8.0,
            wiggle: [0.0, 1.0],
            lateral: 0.0,
            quantum: 0.0,
            disparity_quantum: 0.0,
            max_range: f32::INFINITY,
            edge_step: 0.02,
            edge_radius: 1,
            edge_dropout: 0.0,
            flying: 0.0,
            grazing_limit: std::f32::consts::FRAC_PI_2,
            hole_share: 0.0,
            hole_radius: 0.0,
            glare: f32::INFINITY,
            color_noise: 0.0,
            exposure: 0.0,
            brightness_swing: 0.0,
        }
    }

    /// A structured-light camera: about 1.1 mm noise at 0.6 m, 1 mm steps, missing depth at edges, grazing angles
    /// and in small holes.
    pub fn structured_light() -> Self {
        Self {
            depth_base: 0.000_4,
            depth_quadratic: 0.001_9,
            depth_grazing: 0.000_1,
            lateral: 0.4,
            quantum: 0.001,
            max_range: 4.0,
            edge_radius: 2,
            edge_dropout: 0.35,
            flying: 0.03,
            grazing_limit: 75f32.to_radians(),
            hole_share: 0.012,
            hole_radius: 5.0,
            color_noise: 2.5,
            brightness_swing: 0.05,
            ..Self::perfect()
        }
    }

    /// A time-of-flight camera: little noise on bright surfaces and more on dark and distant ones, a systematic
    /// error that waves with the distance, many flying pixels and few holes.
    pub fn time_of_flight() -> Self {
        Self {
            depth_base: 0.000_3,
            depth_amplitude: 0.001_0,
            depth_grazing: 0.000_05,
            wiggle: [0.001_5, 0.47],
            lateral: 0.3,
            quantum: 0.001,
            max_range: 4.5,
            edge_radius: 1,
            edge_dropout: 0.10,
            flying: 0.25,
            grazing_limit: 80f32.to_radians(),
            color_noise: 2.0,
            brightness_swing: 0.05,
            ..Self::perfect()
        }
    }

    /// A bad structured-light camera: three times the noise, half of its power correlated over ten pixels, steps
    /// of disparity (2.85 mm at 1 m, as Khoshelham and Elberink measured), and a sixth of the image in holes.
    pub fn poor_structured_light() -> Self {
        Self {
            depth_base: 0.001_0,
            depth_quadratic: 0.005_0,
            depth_grazing: 0.000_3,
            correlated: 0.007,
            correlation: 10.0,
            lateral: 0.7,
            disparity_quantum: 0.002_85,
            edge_radius: 3,
            edge_dropout: 0.55,
            flying: 0.08,
            grazing_limit: 65f32.to_radians(),
            hole_share: 0.18,
            hole_radius: 11.0,
            ..Self::structured_light()
        }
    }
}
