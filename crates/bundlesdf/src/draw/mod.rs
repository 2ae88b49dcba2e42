//! What a run found, drawn over its frames: the object's box, its axes, the outline of its mesh, the mask.

mod animation;
mod canvas;
mod oriented_box;
mod silhouette;

use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3, Vector3};
use rgbd_io::{Error, Image, Intrinsics, Mask};

pub(crate) use self::oriented_box::direction;
pub use self::{
    animation::{Animation, AnimationError},
    oriented_box::OrientedBox,
};
use self::{
    canvas::{Canvas, Pen},
    silhouette::{outline, silhouette},
};
use crate::{output::OutputFolder, tracker::Status};

/// Which things are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layers {
    /// The smallest box around the mesh; edges behind the object are dashed.
    pub bounds: bool,
    /// The object frame: x red, y green, z blue.
    pub axes: bool,
    /// The outline of the mesh as the camera would see it without anything in front.
    pub contour: bool,
    /// The mask that the frame was tracked with.
    pub mask: bool,
}

impl Layers {
    /// Everything but the mask.
    pub const POSE: Self = Self { bounds: true, axes: true, contour: true, mask: false };
    /// The names that [`Layers::from_names`] knows.
    pub const NAMES: [&str; 4] = ["box", "axes", "contour", "mask"];

    /// The layers of a comma-separated list of [`Layers::NAMES`].
    ///
    /// # Errors
    /// With a sentence about the first name that is unknown.
    pub fn from_names(list: &str) -> Result<Self, String> {
        let mut layers = Self { bounds: false, axes: false, contour: false, mask: false };
        for name in list.split(',').map(str::trim) {
            match name {
                "box" => layers.bounds = true,
                "axes" => layers.axes = true,
                "contour" => layers.contour = true,
                "mask" => layers.mask = true,
                other => return Err(format!("\"{other}\" is none of {}", Self::NAMES.join(", "))),
            }
        }
        Ok(layers)
    }
}

/// A frame as it is drawn on.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// RGB colour.
    pub color: &'a Image<[u8; 3]>,
    /// The camera of `color`.
    pub intrinsics: Intrinsics,
    /// The object's pose.
    pub cam_from_obj: Isometry3<f64>,
    /// How much the pose can be trusted: a lost frame's drawing is pale.
    pub status: Status,
    /// The mask, of any size.
    pub mask: Option<&'a Mask>,
}

/// Draws one run's object over frames.
#[derive(Clone, Debug)]
pub struct Overlay {
    mesh: Option<TriMesh>,
    bounds: Option<OrientedBox>,
}

impl Overlay {
    /// Length of the axes when there is no mesh to compare with (metres).
    const BARE_AXES: f64 = 0.05;

    /// For an object with this surface; without one, only axes and masks can be drawn.
    #[must_use]
    pub fn new(mesh: Option<TriMesh>) -> Self {
        let bounds = mesh.as_ref().and_then(|mesh| OrientedBox::around(&mesh.vertices));
        Self { mesh, bounds }
    }

    /// For the results in a folder.
    ///
    /// # Errors
    /// When the mesh is there and can't be read.
    pub fn open(folder: &OutputFolder) -> Result<Self, Error> {
        Ok(Self::new(folder.read_mesh()?))
    }

    /// The smallest box around the mesh.
    #[must_use]
    pub fn bounds(&self) -> Option<&OrientedBox> {
        self.bounds.as_ref()
    }

    /// The surface.
    #[must_use]
    pub fn mesh(&self) -> Option<&TriMesh> {
        self.mesh.as_ref()
    }

    /// The frame with `layers` drawn over it.
    #[must_use]
    pub fn draw(&self, view: &View<'_>, layers: Layers) -> Image<[u8; 3]> {
        let (width, height) = view.color.size();
        let mut canvas = Canvas::new(view.color);
        // Lines keep their look from thumbnails to full size.
        let unit = (width.min(height) as f32 / 480.0).clamp(0.6, 4.0);
        let strength = if view.status == Status::Lost { 0.45 } else { 1.0 };
        if let Some(mask) = view.mask.filter(|_| layers.mask) {
            let (w, h) = mask.size();
            let object = Mask::from_fn(width, height, |x, y| {
                mask.get((2 * x + 1) * w / (2 * width), (2 * y + 1) * h / (2 * height)).copied().unwrap_or(0)
            });
            canvas.tint(&object, MASK, 0.35 * strength);
            canvas.tint(&outline(&object), MASK, 0.9 * strength);
        }
        if let Some(mesh) = self.mesh.as_ref().filter(|_| layers.contour) {
            let object = silhouette(mesh, &view.cam_from_obj, &view.intrinsics, (width, height));
            canvas.tint(&outline(&object), CONTOUR, strength);
        }
        if let Some(bounds) = self.bounds.as_ref().filter(|_| layers.bounds) {
            draw_box(&mut canvas, bounds, view, unit, strength);
        }
        if layers.axes {
            self.draw_axes(&mut canvas, view, unit, strength);
        }
        canvas.badge(status_color(view.status), unit);
        canvas.into_image()
    }

    fn draw_axes(&self, canvas: &mut Canvas, view: &View<'_>, unit: f32, strength: f32) {
        let length = self.bounds.as_ref().map_or(Self::BARE_AXES, |b| 0.6 * b.size.max());
        for (axis, color) in [Vector3::x(), Vector3::y(), Vector3::z()].into_iter().zip(AXES) {
            let pen = Pen { color, width: 2.6 * unit, alpha: strength, dashed: false };
            let ends = [Point3::origin(), Point3::from(axis * length)];
            if let Some(line) = project_segment(view, ends) {
                canvas.line(line, &pen);
            }
        }
    }
}

const MASK: [u8; 3] = [64, 156, 255];
const CONTOUR: [u8; 3] = [255, 222, 89];
const BOX: [u8; 3] = [255, 255, 255];
const AXES: [[u8; 3]; 3] = [[240, 72, 72], [60, 200, 96], [74, 134, 255]];

/// The colour that stands for a status in pictures and plots.
#[must_use]
pub fn status_color(status: Status) -> [u8; 3] {
    match status {
        Status::Tracked => [47, 158, 91],
        Status::Relocalised => [59, 130, 246],
        Status::Weak => [230, 162, 0],
        Status::Lost => [214, 69, 65],
    }
}

fn draw_box(canvas: &mut Canvas, bounds: &OrientedBox, view: &View<'_>, unit: f32, strength: f32) {
    let camera = view.cam_from_obj.inverse_transform_point(&Point3::origin());
    // Hidden edges first, so that visible ones lie on top.
    for hidden in [true, false] {
        for (ends, _) in bounds.edges(&camera).into_iter().filter(|(_, visible)| *visible != hidden) {
            let pen = Pen {
                color: BOX,
                width: if hidden { 1.0 } else { 1.7 } * unit,
                alpha: if hidden { 0.55 } else { 0.95 } * strength,
                dashed: hidden,
            };
            if let Some(line) = project_segment(view, ends) {
                canvas.line(line, &pen);
            }
        }
    }
}

/// The pixels between which a segment of the object frame appears; the part behind the camera is cut off.
fn project_segment(view: &View<'_>, ends: [Point3<f64>; 2]) -> Option<[[f64; 2]; 2]> {
    const NEAR: f64 = 0.02;
    let [a, b] = ends.map(|p| (view.cam_from_obj * p).coords);
    if a.z < NEAR && b.z < NEAR {
        return None;
    }
    let cut = |near: Vector3<f64>, far: Vector3<f64>| {
        if near.z < NEAR { far + (near - far) * ((far.z - NEAR) / (far.z - near.z)) } else { near }
    };
    let (a, b) = (cut(a, b), cut(b, a));
    Some([view.intrinsics.project(a.into())?, view.intrinsics.project(b.into())?])
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Translation3;

    /// A cube with an edge of 10 cm around the origin.
    fn cube() -> TriMesh {
        let corner = |i: usize| [0, 1, 2].map(|a| if i >> a & 1 == 1 { 0.05 } else { -0.05_f32 });
        let triangles = vec![
            [0, 2, 1],
            [1, 2, 3],
            [4, 5, 6],
            [5, 7, 6],
            [0, 1, 4],
            [1, 5, 4],
            [2, 6, 3],
            [3, 6, 7],
            [0, 4, 2],
            [2, 4, 6],
            [1, 3, 5],
            [3, 7, 5],
        ];
        TriMesh { vertices: (0..8).map(corner).collect(), triangles, ..TriMesh::default() }
    }

    fn view(color: &Image<[u8; 3]>, z: f64, status: Status) -> View<'_> {
        View {
            color,
            intrinsics: Intrinsics { fx: 200.0, fy: 200.0, cx: 79.5, cy: 59.5 },
            cam_from_obj: Translation3::new(0.0, 0.0, z).into(),
            status,
            mask: None,
        }
    }

    #[test]
    fn the_contour_of_a_cube_is_where_its_front_face_projects() {
        let grey = Image::filled(160, 120, [90; 3]);
        let layers = Layers::from_names("contour").unwrap();
        let drawn = Overlay::new(Some(cube())).draw(&view(&grey, 0.45, Status::Tracked), layers);
        // Front face at 0.4 m: half an edge is 200 * 0.05 / 0.4 = 25 pixels.
        let changed = |x: usize, y: usize| *drawn.get(x, y).unwrap() != [90; 3];
        let first = (20..80).find(|x| changed(*x, 60)).unwrap();
        let last = (80..140).rfind(|x| changed(*x, 60)).unwrap();
        assert!(first.abs_diff(54) <= 2 && last.abs_diff(105) <= 2, "{first} {last}");
        assert!(!changed(80, 60) && !changed(30, 60), "only the outline is drawn");
    }

    #[test]
    fn what_is_behind_the_camera_or_absent_leaves_the_frame_alone() {
        let grey = Image::filled(160, 120, [90; 3]);
        let count = |overlay: &Overlay, z: f64| {
            let drawn = overlay.draw(&view(&grey, z, Status::Tracked), Layers::POSE);
            drawn.pixels().iter().filter(|p| **p != [90; 3]).count()
        };
        let badge = count(&Overlay::new(Some(cube())), -1.0);
        assert!(badge < 200, "{badge} pixels were drawn for an object behind the camera");
        assert!(count(&Overlay::new(Some(cube())), 0.45) > 3 * badge);
        // Axes are drawn without a mesh too.
        assert!(count(&Overlay::new(None), 0.45) > badge);
        // The camera inside the object: no panic, something sensible.
        count(&Overlay::new(Some(cube())), 0.0);
    }

    #[test]
    fn names_of_layers() {
        assert_eq!(Layers::from_names("box,axes, contour").unwrap(), Layers::POSE);
        assert!(Layers::from_names("box,ghost").unwrap_err().contains("ghost"));
    }
}
