//! The suite's objects: shapes with print.

use super::solids;
use crate::texture::{Layer, Mapping, Pattern};
use crate::{Gloss, Object, Shape, Texture};
use std::sync::{Arc, OnceLock};

/// A function that builds its object at the first call and shares it afterwards.
macro_rules! objects {
    ($($name:ident: $voxel:expr, $shape:expr, $texture:expr;)*) => {$(
        pub(super) fn $name() -> Arc<Object> {
            static OBJECT: OnceLock<Arc<Object>> = OnceLock::new();
            OBJECT.get_or_init(|| Arc::new(built($shape, $texture, $voxel))).clone()
        }
    )*};
}

objects! {
    head: 0.0018, solids::head(), Texture::plain([0.80, 0.78, 0.73]);
    can: 0.0016, solids::can(), Texture::plain([0.62, 0.66, 0.70]);
    lantern: 0.0013, solids::lantern(), lantern_print();
    carton: 0.0018, solids::carton(), carton_print();
    mug: 0.0018, solids::mug(), mug_print();
    robot: 0.0017, solids::robot(), robot_print();
    drill: 0.0019, solids::drill(), drill_print();
    car: 0.0014, solids::car(), car_print();
    bottle: 0.0018, solids::bottle(), bottle_print();
    kettle: 0.0024, solids::kettle(1.0), kettle_print(1.0);
    teapot: 0.0018, solids::kettle(0.6), kettle_print(0.6);
}

pub(super) fn flask() -> Arc<Object> {
    static OBJECT: OnceLock<Arc<Object>> = OnceLock::new();
    let gloss = Gloss { strength: 1.1, exponent: 90, mirror: 0.22 };
    OBJECT.get_or_init(|| Arc::new(built(solids::flask(), flask_print(), 0.0018).with_gloss(gloss))).clone()
}

/// A stiff printed card with half the edge lengths `half`, metres.
pub(super) fn card(half: [f32; 3], seed: u32) -> Arc<Object> {
    let texture = Texture {
        palette: vec![[0.62, 0.50, 0.34], [0.74, 0.61, 0.43]],
        scale: 0.05,
        octaves: 3,
        layers: vec![glyphs(0.018, 0.35, Mapping::Cube, [0.25, 0.22, 0.20])],
        seed,
    };
    Arc::new(Object::from_closed(crate::tessellate::cuboid(half), texture))
}

/// The extents are constants, so that extraction can't fail.
fn built(shape: Shape, texture: Texture, voxel: f32) -> Object {
    let empty = texture.clone();
    Object::from_shape(shape, texture, voxel).unwrap_or_else(|_| Object::from_mesh(Default::default(), empty))
}

fn layer(pattern: Pattern, color: [f32; 3]) -> Layer {
    Layer { pattern, color, band: None }
}

fn glyphs(cell: f32, density: f32, mapping: Mapping, color: [f32; 3]) -> Layer {
    layer(Pattern::Glyphs { cell, density, mapping }, color)
}

impl Layer {
    fn within(self, low: f32, high: f32) -> Self {
        Self { band: Some([low, high]), ..self }
    }
}

fn texture(palette: &[[f32; 3]], scale: f32, seed: u32, layers: Vec<Layer>) -> Texture {
    Texture { palette: palette.to_vec(), scale, octaves: 4, layers, seed }
}

fn lantern_print() -> Texture {
    let around = Mapping::Cylinder { radius_um: 36_000 };
    texture(
        &[[0.16, 0.30, 0.24], [0.28, 0.46, 0.34]],
        0.02,
        51,
        vec![
            layer(Pattern::Solid, [0.86, 0.80, 0.62]).within(0.058, 0.075),
            glyphs(0.011, 0.85, around, [0.45, 0.12, 0.10]).within(0.059, 0.0745),
            layer(Pattern::Speckle { cell: 0.008, radius: 0.0025 }, [0.95, 0.80, 0.35]).within(-0.07, -0.04),
        ],
    )
}

fn flask_print() -> Texture {
    texture(
        &[[0.05, 0.10, 0.22], [0.08, 0.16, 0.30], [0.10, 0.12, 0.20]],
        0.03,
        52,
        vec![
            layer(Pattern::Solid, [0.70, 0.66, 0.58]).within(-0.010, -0.004),
            layer(Pattern::Patches { scale: 0.022, threshold: 0.60 }, [0.36, 0.12, 0.14])
                .within(0.005, 0.062),
            glyphs(0.012, 0.8, Mapping::Cube, [0.78, 0.76, 0.66]).within(0.022, 0.046),
        ],
    )
}

fn carton_print() -> Texture {
    texture(
        &[[0.90, 0.88, 0.82], [0.84, 0.83, 0.80]],
        0.03,
        53,
        vec![
            layer(Pattern::Solid, [0.16, 0.42, 0.62]).within(0.030, 0.080),
            layer(Pattern::Patches { scale: 0.020, threshold: 0.56 }, [0.90, 0.62, 0.18])
                .within(0.026, 0.066),
            layer(Pattern::Solid, [0.70, 0.16, 0.15]).within(-0.085, -0.052),
            glyphs(0.014, 0.9, Mapping::Cube, [0.12, 0.16, 0.30]).within(-0.046, -0.004),
            glyphs(0.008, 0.8, Mapping::Cube, [0.95, 0.94, 0.90]).within(0.036, 0.060),
            layer(Pattern::Speckle { cell: 0.011, radius: 0.0035 }, [0.20, 0.55, 0.35]).within(-0.004, 0.024),
        ],
    )
}

fn mug_print() -> Texture {
    let around = Mapping::Cylinder { radius_um: 40_000 };
    texture(
        &[[0.82, 0.78, 0.70], [0.70, 0.62, 0.52], [0.80, 0.70, 0.45]],
        0.03,
        54,
        vec![
            layer(
                Pattern::Stripes { direction: [0.8, 0.5, 0.2], period: 0.016, duty: 0.40, warp: 0.010 },
                [0.20, 0.36, 0.46],
            )
            .within(-0.050, -0.016),
            layer(Pattern::Patches { scale: 0.018, threshold: 0.58 }, [0.72, 0.24, 0.16])
                .within(-0.012, 0.034),
            glyphs(0.013, 0.8, around, [0.16, 0.14, 0.18]).within(-0.010, 0.030),
            layer(Pattern::Solid, [0.24, 0.40, 0.28]).within(0.036, 0.060),
        ],
    )
}

fn robot_print() -> Texture {
    texture(
        &[[0.76, 0.30, 0.16], [0.86, 0.50, 0.20], [0.64, 0.20, 0.18]],
        0.028,
        55,
        vec![
            layer(Pattern::Solid, [0.55, 0.60, 0.62]).within(-0.090, -0.028),
            layer(Pattern::Patches { scale: 0.016, threshold: 0.60 }, [0.24, 0.30, 0.46])
                .within(-0.066, -0.026),
            glyphs(0.010, 0.8, Mapping::Cube, [0.10, 0.10, 0.14]).within(-0.056, 0.028),
            layer(Pattern::Solid, [0.24, 0.28, 0.36]).within(0.036, 0.080),
            layer(Pattern::Speckle { cell: 0.009, radius: 0.003 }, [0.92, 0.86, 0.55]).within(0.036, 0.080),
        ],
    )
}

fn drill_print() -> Texture {
    texture(
        &[[0.12, 0.40, 0.38], [0.16, 0.52, 0.48], [0.10, 0.30, 0.34]],
        0.03,
        56,
        vec![
            layer(Pattern::Solid, [0.20, 0.20, 0.22]).within(0.046, 0.090),
            layer(Pattern::Patches { scale: 0.020, threshold: 0.60 }, [0.16, 0.17, 0.20])
                .within(-0.020, 0.046),
            layer(
                Pattern::Stripes { direction: [1.0, 0.3, 0.2], period: 0.024, duty: 0.35, warp: 0.008 },
                [0.90, 0.70, 0.20],
            )
            .within(-0.070, -0.018),
            glyphs(0.011, 0.75, Mapping::Cube, [0.93, 0.93, 0.90]).within(-0.056, 0.080),
        ],
    )
}

fn car_print() -> Texture {
    texture(
        &[[0.72, 0.12, 0.12], [0.84, 0.24, 0.16]],
        0.02,
        57,
        vec![
            layer(Pattern::Solid, [0.14, 0.14, 0.16]).within(0.013, 0.040),
            layer(Pattern::Solid, [0.80, 0.86, 0.90]).within(-0.024, -0.010),
            glyphs(0.012, 0.7, Mapping::Cube, [0.96, 0.92, 0.70]).within(-0.008, 0.012),
            layer(Pattern::Solid, [0.20, 0.30, 0.70]).within(-0.040, -0.026),
        ],
    )
}

fn bottle_print() -> Texture {
    texture(
        &[[0.18, 0.30, 0.66], [0.24, 0.44, 0.80], [0.30, 0.30, 0.70]],
        0.03,
        58,
        vec![
            layer(Pattern::Solid, [0.92, 0.90, 0.84]).within(0.000, 0.056),
            layer(Pattern::Patches { scale: 0.022, threshold: 0.58 }, [0.92, 0.56, 0.22])
                .within(-0.004, 0.060),
            glyphs(0.012, 0.85, Mapping::Cube, [0.62, 0.12, 0.22]).within(0.004, 0.038),
            glyphs(0.007, 0.85, Mapping::Cube, [0.12, 0.14, 0.24]).within(0.040, 0.056),
            layer(Pattern::Solid, [0.86, 0.30, 0.20]).within(-0.090, -0.054),
            layer(Pattern::Speckle { cell: 0.010, radius: 0.003 }, [0.85, 0.90, 0.95]).within(-0.054, -0.004),
        ],
    )
}

fn kettle_print(size: f32) -> Texture {
    texture(
        &[[0.72, 0.66, 0.52], [0.84, 0.80, 0.68], [0.62, 0.60, 0.52]],
        0.06 * size,
        59,
        vec![
            layer(Pattern::Patches { scale: 0.045 * size, threshold: 0.57 }, [0.22, 0.42, 0.50])
                .within(-0.040 * size, 0.080 * size),
            layer(Pattern::Speckle { cell: 0.022 * size, radius: 0.007 * size }, [0.74, 0.28, 0.20])
                .within(-0.040 * size, 0.020 * size),
            glyphs(0.026 * size, 0.8, Mapping::Cube, [0.16, 0.14, 0.14]).within(0.016 * size, 0.070 * size),
            layer(Pattern::Solid, [0.20, 0.26, 0.22]).within(0.084 * size, 0.120 * size),
            layer(Pattern::Solid, [0.26, 0.20, 0.16]).within(-0.140 * size, -0.062 * size),
            layer(
                Pattern::Stripes {
                    direction: [1.0, 0.2, 0.4],
                    period: 0.03 * size,
                    duty: 0.3,
                    warp: 0.01 * size,
                },
                [0.60, 0.42, 0.26],
            )
            .within(-0.140 * size, -0.062 * size),
        ],
    )
}
