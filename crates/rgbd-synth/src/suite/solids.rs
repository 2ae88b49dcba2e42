//! The suite's shapes. All stand upright with y towards the foot, around the origin, in metres.

use crate::Shape;
use crate::presets::turned;
use nalgebra::Vector3;

fn lathe(profile: &[[f32; 2]], rounding: f32) -> Shape {
    Shape::Lathe { profile: profile.to_vec(), rounding }
}

fn tube(points: &[[f32; 4]]) -> Shape {
    Shape::Tube { points: points.to_vec() }
}

fn block(half: [f32; 3], radius: f32, place: [f32; 3], turn: [f32; 3]) -> Shape {
    Shape::RoundedBox { half, radius }.placed(turned(place, Vector3::from(turn)))
}

fn ball(radius: f32, place: [f32; 3]) -> Shape {
    Shape::Sphere { radius }.placed(turned(place, Vector3::zeros()))
}

fn union(parts: Vec<Shape>, blend: f32) -> Shape {
    Shape::Union { parts, blend }
}

/// A plaster head: no side like another, but nothing printed on it.
pub(super) fn head() -> Shape {
    let skull = lathe(
        &[
            [0.0, 0.070],
            [0.040, 0.070],
            [0.040, 0.060],
            [0.024, 0.048],
            [0.022, 0.034],
            [0.038, 0.012],
            [0.042, -0.020],
            [0.034, -0.050],
            [0.0, -0.064],
        ],
        0.003,
    );
    let nose = tube(&[[0.036, -0.028, 0.0, 0.006], [0.056, -0.002, 0.002, 0.010]]);
    let ears = [-1.0f32, 1.0]
        .map(|s| block([0.009, 0.016, 0.005], 0.004, [-0.004, -0.010, 0.043 * s], [0.3 * s, 0.3, 0.0]));
    let bun = ball(0.020, [-0.040, -0.040, 0.008]);
    let quiff = tube(&[[-0.006, -0.060, -0.012, 0.014], [0.022, -0.072, 0.004, 0.009]]);
    let [left, right] = ears;
    union(vec![skull, nose, left, right, bun, quiff], 0.010)
}

/// A can: exactly a surface of revolution.
pub(super) fn can() -> Shape {
    lathe(
        &[
            [0.0, 0.058],
            [0.026, 0.058],
            [0.0265, 0.061],
            [0.029, 0.061],
            [0.033, 0.052],
            [0.033, 0.020],
            [0.0318, 0.016],
            [0.033, 0.012],
            [0.0318, 0.006],
            [0.033, 0.001],
            [0.033, -0.046],
            [0.027, -0.058],
            [0.0275, -0.061],
            [0.025, -0.061],
            [0.0245, -0.057],
            [0.0, -0.057],
        ],
        0.000_8,
    )
}

/// A lantern: a solid foot and cap, and wires between them.
pub(super) fn lantern() -> Shape {
    let foot = lathe(&[[0.0, 0.080], [0.036, 0.080], [0.038, 0.074], [0.035, 0.056], [0.0, 0.056]], 0.002);
    let cap = lathe(&[[0.0, -0.040], [0.022, -0.040], [0.010, -0.056], [0.0, -0.058]], 0.002);
    let mut parts = vec![foot, cap];
    for (i, angle) in [0.0f32, 1.1, 2.3, 3.6, 5.0].into_iter().enumerate() {
        let wide = 0.034 - 0.001 * i as f32;
        let (s, c) = angle.sin_cos();
        let (t, d) = (angle + 0.35).sin_cos();
        parts.push(tube(&[
            [0.031 * c, 0.058, 0.031 * s, 0.002_4],
            [wide * c, 0.004, wide * s, 0.002_0],
            [0.019 * d, -0.041, 0.019 * t, 0.002_2],
        ]));
    }
    let ring: Vec<[f32; 4]> = (0..=20)
        .map(|i| {
            let (s, c) = (std::f32::consts::TAU * i as f32 / 20.0).sin_cos();
            [0.033 * c, 0.006 + 0.006 * c, 0.033 * s, 0.002_0]
        })
        .collect();
    parts.push(tube(&ring));
    // The bail stands askew, which tells front from back.
    parts.push(tube(&[
        [0.020, -0.044, 0.004, 0.002_0],
        [0.024, -0.066, 0.010, 0.002_0],
        [0.008, -0.086, 0.014, 0.002_4],
        [-0.014, -0.084, 0.010, 0.002_2],
        [-0.024, -0.064, 0.000, 0.002_0],
        [-0.018, -0.044, -0.004, 0.002_0],
    ]));
    union(parts, 0.002)
}

/// A flask with a beak and a flat label plate.
pub(super) fn flask() -> Shape {
    let body = lathe(
        &[
            [0.0, 0.070],
            [0.036, 0.070],
            [0.041, 0.062],
            [0.041, 0.000],
            [0.030, -0.026],
            [0.015, -0.040],
            [0.015, -0.062],
            [0.018, -0.066],
            [0.018, -0.074],
            [0.0, -0.074],
        ],
        0.002,
    );
    let handle = tube(&[
        [0.012, -0.056, 0.0, 0.005],
        [0.040, -0.060, 0.0, 0.005],
        [0.058, -0.040, 0.0, 0.005],
        [0.060, -0.010, 0.0, 0.005],
        [0.042, 0.014, 0.0, 0.005],
    ]);
    let beak = tube(&[[-0.012, -0.060, 0.0, 0.007], [-0.032, -0.070, 0.002, 0.005]]);
    let plate = block([0.020, 0.014, 0.005], 0.002, [0.006, 0.034, -0.040], [0.0, 0.1, 0.0]);
    union(vec![union(vec![body, handle, beak], 0.006), plate], 0.0)
}

/// A carton with a screw cap off its middle.
pub(super) fn carton() -> Shape {
    let body = block([0.043, 0.062, 0.026], 0.003, [0.0, 0.006, 0.0], [0.0; 3]);
    let cap = lathe(&[[0.0, -0.054], [0.014, -0.054], [0.014, -0.072], [0.0, -0.072]], 0.001)
        .placed(turned([0.018, 0.0, 0.004], Vector3::zeros()));
    let flap = block([0.030, 0.008, 0.002], 0.001, [-0.010, -0.060, -0.018], [0.35, 0.0, 0.0]);
    union(vec![body, cap, flap], 0.0)
}

/// A hollow mug with a handle.
pub(super) fn mug() -> Shape {
    let solid =
        lathe(&[[0.0, 0.050], [0.034, 0.050], [0.039, 0.044], [0.041, -0.050], [0.0, -0.050]], 0.001_5);
    let hollow = lathe(&[[0.0, 0.044], [0.035, 0.056], [0.0375, -0.060], [0.0, -0.060]], 0.001);
    let handle = tube(&[
        [0.037, -0.034, 0.0, 0.006],
        [0.058, -0.036, 0.0, 0.0055],
        [0.069, -0.014, 0.0, 0.005],
        [0.064, 0.014, 0.0, 0.0055],
        [0.038, 0.032, 0.0, 0.006],
    ]);
    let shell = union(vec![solid, handle], 0.005);
    Shape::Difference(Box::new(shell), Box::new(hollow))
}

/// A toy robot, waving.
pub(super) fn robot() -> Shape {
    union(
        vec![
            block([0.030, 0.030, 0.021], 0.004, [0.0, 0.006, 0.0], [0.0; 3]),
            block([0.023, 0.018, 0.018], 0.004, [0.002, -0.044, 0.0], [0.0, 0.35, 0.06]),
            block([0.010, 0.022, 0.014], 0.003, [-0.016, 0.056, -0.003], [0.1, 0.0, 0.0]),
            block([0.010, 0.022, 0.014], 0.003, [0.016, 0.056, 0.004], [-0.1, 0.0, 0.0]),
            tube(&[
                [0.030, -0.012, 0.0, 0.008],
                [0.050, -0.022, -0.006, 0.007],
                [0.056, -0.050, -0.012, 0.008],
            ]),
            tube(&[
                [-0.030, -0.010, 0.0, 0.008],
                [-0.046, 0.010, 0.010, 0.007],
                [-0.044, 0.030, 0.024, 0.009],
            ]),
            tube(&[[0.010, -0.058, 0.0, 0.003], [0.013, -0.078, 0.003, 0.003]]),
            ball(0.007, [0.0135, -0.080, 0.003]),
            block([0.018, 0.020, 0.009], 0.003, [0.0, 0.004, -0.026], [0.0; 3]),
        ],
        0.0,
    )
}

/// A cordless drill.
pub(super) fn drill() -> Shape {
    let motor = tube(&[[-0.058, -0.040, 0.0, 0.022], [0.020, -0.040, 0.0, 0.024]]);
    let chuck =
        tube(&[[0.030, -0.040, 0.0, 0.018], [0.060, -0.040, 0.0, 0.011], [0.086, -0.040, 0.0, 0.0035]]);
    let grip = tube(&[[-0.026, -0.022, 0.0, 0.016], [-0.034, 0.050, 0.0, 0.015]]);
    let battery = block([0.036, 0.015, 0.024], 0.005, [-0.024, 0.066, 0.0], [0.0, 0.0, -0.1]);
    let trigger = block([0.007, 0.011, 0.006], 0.003, [-0.006, -0.008, 0.0], [0.0; 3]);
    let lever = block([0.009, 0.004, 0.007], 0.002, [-0.034, -0.064, 0.004], [0.0, 0.4, 0.0]);
    union(vec![union(vec![motor, grip], 0.010), chuck, battery, trigger, lever], 0.002)
}

/// A toy car of 8 cm.
pub(super) fn car() -> Shape {
    let wheel = |x: f32, z: f32| {
        lathe(&[[0.0, 0.006], [0.0095, 0.006], [0.0095, -0.006], [0.0, -0.006]], 0.001)
            .placed(turned([x, 0.016, z], Vector3::new(std::f32::consts::FRAC_PI_2, 0.0, 0.0)))
    };
    union(
        vec![
            block([0.040, 0.011, 0.018], 0.004, [0.0, 0.004, 0.0], [0.0; 3]),
            block([0.020, 0.012, 0.016], 0.005, [-0.007, -0.014, 0.0], [0.0; 3]),
            block([0.006, 0.003, 0.010], 0.001, [-0.002, -0.028, 0.0], [0.0; 3]),
            wheel(0.025, 0.018),
            wheel(0.025, -0.018),
            wheel(-0.024, 0.018),
            wheel(-0.024, -0.018),
        ],
        0.0,
    )
}

/// A detergent bottle with a grip and a cap aslant.
pub(super) fn bottle() -> Shape {
    let body = block([0.036, 0.050, 0.024], 0.014, [0.0, 0.024, 0.0], [0.0; 3]);
    let neck = tube(&[[-0.014, -0.028, 0.0, 0.020], [-0.014, -0.052, 0.0, 0.012]]);
    let grip = tube(&[
        [0.000, -0.034, 0.0, 0.009],
        [0.030, -0.036, 0.0, 0.009],
        [0.044, -0.016, 0.0, 0.008],
        [0.034, 0.006, 0.0, 0.010],
    ]);
    let cap = lathe(&[[0.0, 0.010], [0.016, 0.010], [0.013, -0.012], [0.0, -0.012]], 0.001)
        .placed(turned([-0.014, -0.066, 0.0], Vector3::new(0.0, 0.0, -0.15)));
    union(vec![union(vec![body, neck, grip], 0.012), cap], 0.0)
}

/// A kettle of 24 cm times `size`.
pub(super) fn kettle(size: f32) -> Shape {
    let flat = |points: &[[f32; 2]]| points.iter().map(|p| p.map(|v| v * size)).collect::<Vec<_>>();
    let thick = |points: &[[f32; 4]]| points.iter().map(|p| p.map(|v| v * size)).collect::<Vec<_>>();
    let body = lathe(
        &flat(&[
            [0.0, 0.095],
            [0.076, 0.095],
            [0.083, 0.083],
            [0.074, 0.000],
            [0.050, -0.042],
            [0.044, -0.046],
            [0.042, -0.054],
            [0.012, -0.064],
            [0.0, -0.064],
        ]),
        0.003 * size,
    );
    let knob = ball(0.013 * size, [0.0, -0.072 * size, 0.0]);
    let handle = tube(&thick(&[
        [0.046, -0.036, 0.0, 0.009],
        [0.066, -0.088, 0.006, 0.009],
        [0.030, -0.116, 0.010, 0.010],
        [-0.024, -0.114, 0.008, 0.010],
        [-0.054, -0.080, 0.002, 0.009],
        [-0.046, -0.034, 0.0, 0.009],
    ]));
    let spout = tube(&thick(&[
        [-0.060, 0.046, 0.0, 0.022],
        [-0.098, 0.010, 0.008, 0.014],
        [-0.118, -0.030, 0.014, 0.011],
    ]));
    let plate = block(
        [0.030, 0.022, 0.008].map(|v| v * size),
        0.003 * size,
        [0.014, 0.040, -0.076].map(|v| v * size),
        [-0.12, -0.18, 0.0],
    );
    union(vec![union(vec![body, handle, spout], 0.008 * size), knob, plate], 0.0)
}
