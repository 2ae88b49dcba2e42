//! The choice of a method.

use crate::frame_to_frame::FrameToFrame;
use crate::kinectfusion::KinectFusion;
use crate::sdf2sdf::Sdf2Sdf;
use crate::tracker::FusingTracker;
use marching_cubes::TriMesh;
use nalgebra::Isometry3;
use rgbd_io::RgbdFrame;

/// Where the object is in one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Maps the object's frame to the camera's. Of a frame that was not tracked: the last tracked pose, or the identity
    /// if there is none.
    pub cam_from_obj: Isometry3<f64>,
    /// Whether this frame itself says so.
    pub tracked: bool,
}

/// Follows one rigid object through a video and reconstructs it.
pub trait ObjectTracker {
    /// The pose in the next frame. Only what [`RgbdFrame::mask`] covers is looked at; a frame without mask, with almost
    /// no depth in it, or with images of different sizes is not tracked.
    fn track(&mut self, frame: &RgbdFrame) -> Pose;

    /// The surface reconstructed so far, in the object's frame (metres), with normals and colours, sampled every
    /// `spacing_m` metres (between half a voxel and a voxel: see [`crate::tsdf::TsdfVolume::mesh`]); open where nothing was seen.
    fn mesh(&self, spacing_m: f32) -> TriMesh;
}

/// Numbers that the methods share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BaselineConfig {
    /// Edge of a voxel, metres. Without a value: a hundredth of the object's first view, but not less than half a pixel
    /// there.
    pub voxel_m: Option<f32>,
    /// Half the width of the band around the surface in which distances are kept, voxels; at least 2. It is also the
    /// scale of all gates on distances.
    pub truncation_voxels: f32,
    /// Weight at which a voxel starts to forget, about that many views.
    pub max_weight: f32,
    /// A longer step of the object's origin since the last tracked frame is a failure, metres.
    pub max_step_m: f64,
    /// A larger turn since the last tracked frame is a failure, radians.
    pub max_step_rad: f64,
    /// Seed of RANSAC.
    pub seed: u64,
}

impl Default for BaselineConfig {
    fn default() -> Self {
        Self {
            voxel_m: None,
            truncation_voxels: 5.0,
            max_weight: 64.0,
            max_step_m: 0.2,
            max_step_rad: 0.8,
            seed: 0,
        }
    }
}

/// A method to compare with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Baseline {
    /// Frame-to-model projective ICP against a fused volume (Newcombe et al., ISMAR 2011).
    KinectFusion,
    /// Frame-to-model alignment of signed distance fields (Slavcheva et al., ECCV 2016 and IJCV 2018).
    Sdf2Sdf,
    /// Chained motions between neighbouring frames from followed corners, RANSAC and ICP.
    FrameToFrame,
}

impl Baseline {
    /// All methods.
    pub const ALL: [Self; 3] = [Self::KinectFusion, Self::Sdf2Sdf, Self::FrameToFrame];

    /// The names of all methods, in the order of [`Self::ALL`].
    pub fn names() -> [&'static str; 3] {
        Self::ALL.map(Self::name)
    }

    /// Name for command lines and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::KinectFusion => "kinectfusion",
            Self::Sdf2Sdf => "sdf2sdf",
            Self::FrameToFrame => "frame-to-frame",
        }
    }

    /// The method of that [name](Self::name), capital letters or not.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|method| method.name().eq_ignore_ascii_case(name))
    }

    /// A tracker that has seen nothing yet.
    pub fn tracker(self, config: &BaselineConfig) -> Box<dyn ObjectTracker + Send> {
        match self {
            Self::KinectFusion => Box::new(FusingTracker::new(KinectFusion, *config)),
            Self::Sdf2Sdf => Box::new(FusingTracker::new(Sdf2Sdf, *config)),
            Self::FrameToFrame => Box::new(FusingTracker::new(FrameToFrame::new(config.seed), *config)),
        }
    }
}
