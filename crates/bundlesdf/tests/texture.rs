//! Texture baking against the truth: views that were not used for it are rendered and compared.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use bundlesdf::texture::{TextureError, TextureOptions, TexturedMesh, View, bake};
use marching_cubes::TriMesh;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rgbd_io::{Image, Intrinsics};
use rgbd_synth::{Backdrop, Light, MaskFaults, Masks, Motion, Sensor, Sequence, SequenceSpec, jug};

const VIEWS: usize = 30;
const HELD_OUT: usize = 8;

/// Views spread evenly over all directions; times from `VIEWS` on are held out.
fn pose(time: f64) -> Isometry3<f64> {
    let i = (time + 0.5).floor();
    let (i, n) =
        if i < VIEWS as f64 { (i, VIEWS as f64) } else { (i - VIEWS as f64 + 0.37, HELD_OUT as f64) };
    let (y, turn) = (1.0 - 2.0 * (i + 0.5) / n, i * 2.399_963);
    let r = (1.0 - y * y).max(0.0).sqrt();
    let eye = Point3::from(Vector3::new(r * turn.cos(), y, r * turn.sin()) * (0.45 + 0.05 * (i * 1.7).sin()));
    let up = if y.abs() > 0.9 { Vector3::x() } else { Vector3::y() };
    let look = UnitQuaternion::face_towards(&(Point3::origin() - eye), &-up);
    Isometry3::from_parts(Translation3::from(eye.coords), look).inverse()
}

fn sequence(light: Light, sensor: Sensor) -> Sequence {
    Sequence::new(SequenceSpec {
        name: "around".into(),
        frames: VIEWS + HELD_OUT,
        width: 320,
        height: 240,
        intrinsics: Intrinsics { fx: 420.0, fy: 420.0, cx: 159.5, cy: 119.5 },
        seed: 3,
        object: jug(),
        motion: Motion::from_fn(pose),
        camera: None,
        occluders: vec![],
        backdrop: Backdrop::default(),
        light,
        sensor,
        masks: Masks::Every,
        mask_faults: MaskFaults::none(),
    })
    .unwrap()
}

fn views(video: &Sequence) -> Vec<View> {
    let view = |i| {
        let seen = video.render(i);
        View {
            color: seen.frame.color,
            depth: seen.frame.depth,
            mask: seen.visible_mask,
            intrinsics: video.intrinsics(),
            obj_from_cam: seen.cam_from_obj.inverse(),
        }
    };
    (0..VIEWS).map(view).collect()
}

/// Drawn and true values of the object's pixels in all held-out views, and the share of those pixels that the mesh
/// covers. The outermost pixels are left out: the rendered lens mixes them with the backdrop.
fn compared(textured: &TexturedMesh, truth: &Sequence) -> (Vec<[f64; 2]>, f64) {
    let (mut pairs, mut all) = (Vec::new(), 0usize);
    for i in VIEWS..VIEWS + HELD_OUT {
        let seen = truth.render(i);
        let drawn = textured.render(&truth.intrinsics(), seen.frame.color.size(), &seen.cam_from_obj);
        let (width, height) = seen.visible_mask.size();
        let inside = |x: usize, y: usize| {
            (y - 1..=y + 1).all(|v| (x - 1..=x + 1).all(|u| seen.visible_mask[(u, v)] != 0))
        };
        for at in (1..height - 1).flat_map(|y| (1..width - 1).map(move |x| (x, y))) {
            if !inside(at.0, at.1) {
                continue;
            }
            all += 1;
            if drawn.depth[at] > 0.0 {
                let (a, b) = (drawn.color[at], seen.frame.color[at]);
                pairs.extend((0..3).map(|k| [f64::from(a[k]), f64::from(b[k])]));
            }
        }
    }
    let covered = pairs.len() as f64 / (3 * all) as f64;
    (pairs, covered)
}

/// PSNR (dB) of drawn values times `factor`.
fn decibels(pairs: &[[f64; 2]], factor: f64) -> f64 {
    let squares: f64 = pairs.iter().map(|[a, b]| (factor * a - b).powi(2)).sum();
    10.0 * (255.0f64.powi(2) * pairs.len() as f64 / squares).log10()
}

/// PSNR (dB) and the share of the pixels that it is over.
fn psnr(textured: &TexturedMesh, truth: &Sequence) -> (f64, f64) {
    let (pairs, covered) = compared(textured, truth);
    (decibels(&pairs, 1.0), covered)
}

fn options() -> TextureOptions {
    TextureOptions { size: 1024, ..TextureOptions::default() }
}

fn small_mesh() -> TriMesh {
    jug().mesh().simplified(12_000)
}

fn flat() -> Light {
    Light { ambient: 1.0, diffuse: 0.0, specular: 0.0, ..Light::default() }
}

/// The bar of the texture: 24 dB.
#[test]
fn held_out_views_look_like_the_truth() {
    let textured =
        bake(&small_mesh(), &views(&sequence(flat(), Sensor::structured_light())), &options()).unwrap();
    let (db, covered) = psnr(&textured, &sequence(flat(), Sensor::perfect()));
    println!("true poses: {db:.2} dB on {:.1} % of the pixels", 100.0 * covered);
    assert!(db >= 24.0, "{db:.2} dB");
    assert!(covered > 0.98 && textured.stats.observed > 0.97, "{covered} {}", textured.stats.observed);
    // The object has no colour darker than this; nothing observed and nothing filled may be.
    assert!(textured.texture.pixels().iter().all(|c| c.iter().any(|v| *v > 12)));
}

/// The views go around the object under a lamp above them: shading moves over the object, and the texture is to show the
/// object's own colours all the same. How much light fell on it can't be known: one factor on the whole texture is free.
#[test]
fn the_light_of_a_lamp_is_taken_out() {
    let lit = sequence(Light::default(), Sensor::structured_light());
    let textured = bake(&small_mesh(), &views(&lit), &options()).unwrap();
    let (pairs, _) = compared(&textured, &sequence(flat(), Sensor::perfect()));
    let factor =
        pairs.iter().map(|[a, b]| a * b).sum::<f64>() / pairs.iter().map(|[a, _]| a * a).sum::<f64>();
    let db = decibels(&pairs, factor);
    println!("lamp: {db:.2} dB to the object's colours, after a factor of {factor:.2}");
    assert!(db >= 24.0, "{db:.2} dB");
}

/// Poses as a tracker leaves them, off by a millimetre and a third of a degree: the images themselves correct them.
#[test]
fn small_pose_errors_are_corrected() {
    let mut views = views(&sequence(flat(), Sensor::structured_light()));
    for (i, view) in views.iter_mut().enumerate() {
        let a = i as f64 * 2.1;
        let turn = Vector3::new(a.sin(), a.cos(), (2.0 * a).sin()).normalize() * 0.006;
        let shift = Vector3::new((3.0 * a).cos(), (2.0 * a).cos(), a.sin()).normalize() * 0.001;
        view.obj_from_cam = Isometry3::new(shift, turn) * view.obj_from_cam;
    }
    let truth = sequence(flat(), Sensor::perfect());
    let [given, aligned] = [false, true].map(|align| {
        let textured = bake(&small_mesh(), &views, &TextureOptions { align, ..options() }).unwrap();
        psnr(&textured, &truth).0
    });
    println!("pose errors: {given:.2} dB with the given poses, {aligned:.2} dB with corrected ones");
    assert!(aligned > given + 3.0, "{given:.2} {aligned:.2}");
}

/// Views of different exposure give one texture.
#[test]
fn exposure_is_evened_out() {
    let mut views = views(&sequence(flat(), Sensor::structured_light()));
    let exposure = |i: usize| 1.0 + 0.25 * (i as f32 * 1.3).sin();
    for (i, view) in views.iter_mut().enumerate() {
        let brighter = |c: &[u8; 3]| c.map(|v| (f32::from(v) * exposure(i)).min(255.0) as u8);
        view.color = view.color.map(brighter);
    }
    let textured = bake(&small_mesh(), &views, &options()).unwrap();
    let levelled: Vec<f32> = (0..VIEWS).map(|i| exposure(i) * textured.stats.gains[i][1]).collect();
    let mean = levelled.iter().sum::<f32>() / VIEWS as f32;
    let spread = levelled.iter().map(|v| (v / mean - 1.0).abs()).fold(0.0, f32::max);
    assert!(spread < 0.08, "{levelled:?}");
    let (db, _) = psnr(&textured, &sequence(flat(), Sensor::perfect()));
    println!("{db:.2} dB with exposure from 0.75 to 1.25, levelled to within {:.1} %", 100.0 * spread);
    assert!(db >= 24.0, "{db:.2} dB");
}

/// One side alone was seen: the other is filled, not black.
#[test]
fn what_nobody_saw_is_filled() {
    let video = sequence(flat(), Sensor::perfect());
    let first = views(&video)[..3].to_vec();
    let textured = bake(&small_mesh(), &first, &options()).unwrap();
    assert!(textured.stats.observed < 0.8);
    assert!(textured.texture.pixels().iter().all(|c| c.iter().any(|v| *v > 12)));
    assert!(textured.vertex_colors.iter().all(|c| c.iter().any(|v| *v > 12)));
}

#[test]
fn the_result_does_not_depend_on_threads_and_hangs_together() {
    let views = views(&sequence(flat(), Sensor::perfect()));
    let mesh = jug().mesh().simplified(2000);
    let options = TextureOptions { size: 256, ..TextureOptions::default() };
    let a = bake(&mesh, &views, &options).unwrap();
    let one = rayon_of_one(|| bake(&mesh, &views, &options).unwrap());
    assert_eq!(a, one);
    assert_eq!(a.triangles.len(), mesh.triangles.len());
    assert_eq!(a.vertex_colors.len(), mesh.vertices.len());
    assert!(a.triangles.as_flattened().iter().all(|&i| (i as usize) < a.positions.len()));
    for (p, s) in a.positions.iter().zip(&a.source) {
        assert_eq!(*p, mesh.vertices[*s as usize]);
    }
}

fn rayon_of_one<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(work)
}

#[test]
fn unusable_input_is_named() {
    let mesh = jug().mesh().simplified(500);
    let view = View {
        color: Image::filled(8, 8, [100; 3]),
        depth: Image::filled(8, 8, 0.5),
        mask: Image::filled(8, 8, 255),
        intrinsics: Intrinsics { fx: 10.0, fy: 10.0, cx: 3.5, cy: 3.5 },
        obj_from_cam: Isometry3::translation(0.0, 0.0, -0.5),
    };
    let views = [view.clone()];
    let tiny = TextureOptions { size: 128, ..TextureOptions::default() };
    assert_eq!(bake(&TriMesh::default(), &views, &tiny), Err(TextureError::EmptyMesh));
    assert_eq!(bake(&mesh, &[], &tiny), Err(TextureError::NoViews));
    let bad = View { depth: Image::filled(4, 8, 0.5), ..view.clone() };
    assert_eq!(bake(&mesh, &[view.clone(), bad], &tiny), Err(TextureError::View(1)));
    let bad = View { obj_from_cam: Isometry3::translation(f64::NAN, 0.0, 0.0), ..view.clone() };
    assert_eq!(bake(&mesh, &[bad], &tiny), Err(TextureError::View(0)));
    assert_eq!(bake(&mesh, &views, &TextureOptions { size: 0, ..tiny.clone() }), Err(TextureError::Size(0)));
    // A view that sees nothing is no error: everything is filled.
    let blind = View { mask: Image::filled(8, 8, 0), ..view };
    let textured = bake(&mesh, &[blind], &tiny).unwrap();
    assert_eq!(textured.stats.observed, 0.0);
}
