//! The kernels: files of `shaders/`, each with the shared files it needs before it.

/// A kernel by the name of its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kernel {
    ActiveUnits,
    AdamGrid,
    AdamPoses,
    AdamWeights,
    ColorInput,
    ColorLoss,
    Eikonal,
    Encode,
    Finish,
    Linear,
    LinearBack,
    Poses,
    RayTwist,
    Sample,
    Scatter,
    SdfLoss,
    WeightGradient,
}

impl Kernel {
    pub(crate) const ALL: [Self; 17] = [
        Self::ActiveUnits,
        Self::AdamGrid,
        Self::AdamPoses,
        Self::AdamWeights,
        Self::ColorInput,
        Self::ColorLoss,
        Self::Eikonal,
        Self::Encode,
        Self::Finish,
        Self::Linear,
        Self::LinearBack,
        Self::Poses,
        Self::RayTwist,
        Self::Sample,
        Self::Scatter,
        Self::SdfLoss,
        Self::WeightGradient,
    ];

    /// Name of the file without its ending.
    pub(crate) fn name(self) -> &'static str {
        self.files().0
    }

    /// Name, text and shared parts.
    fn files(self) -> (&'static str, &'static str, &'static [&'static str]) {
        macro_rules! file {
            ($name:literal $(, $part:ident)*) => {
                ($name, include_str!(concat!("../../shaders/", $name, ".wgsl")), &[$($part),*])
            };
        }
        match self {
            Self::ActiveUnits => file!("active_units"),
            Self::AdamGrid => file!("adam_grid", SCHEDULE),
            Self::AdamPoses => file!("adam_poses", SCHEDULE, SE3),
            Self::AdamWeights => file!("adam_weights", SCHEDULE),
            Self::ColorInput => file!("color_input", HARMONICS),
            Self::ColorLoss => file!("color_loss"),
            Self::Eikonal => file!("eikonal", SCHEDULE, LATTICE),
            Self::Encode => file!("encode", LATTICE),
            Self::Finish => file!("finish", SCHEDULE),
            Self::Linear => file!("linear"),
            Self::LinearBack => file!("linear_back"),
            Self::Poses => file!("poses", SE3),
            Self::RayTwist => file!("ray_twist", HARMONICS),
            Self::Sample => file!("sample", SCHEDULE, RANDOM),
            Self::Scatter => file!("scatter", LATTICE),
            Self::SdfLoss => file!("sdf_loss"),
            Self::WeightGradient => file!("weight_gradient"),
        }
    }

    /// The kernel's whole text, with sums of floats as the adapter can do them.
    pub(crate) fn source(self, float_atomics: bool) -> String {
        let (_, text, parts) = self.files();
        let mut source = COMMON.to_owned();
        for part in parts {
            source.push_str(part);
        }
        if self == Self::Scatter {
            source.push_str(if float_atomics { ADD_NATIVE } else { ADD_EXCHANGE });
        }
        source.push_str(text);
        source
    }
}

const COMMON: &str = include_str!("../../shaders/lib/common.wgsl");
const SCHEDULE: &str = include_str!("../../shaders/lib/schedule.wgsl");
const RANDOM: &str = include_str!("../../shaders/lib/random.wgsl");
const LATTICE: &str = include_str!("../../shaders/lib/lattice.wgsl");
const HARMONICS: &str = include_str!("../../shaders/lib/harmonics.wgsl");
const SE3: &str = include_str!("../../shaders/lib/se3.wgsl");
const ADD_NATIVE: &str = include_str!("../../shaders/lib/add_native.wgsl");
const ADD_EXCHANGE: &str = include_str!("../../shaders/lib/add_exchange.wgsl");
