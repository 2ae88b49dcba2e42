// Pose corrections xi = tanh(theta) * bounds as twists [rho; phi], translation first (pose.rs, se3-lie).

// Relative accuracy near zero, which the built-in function need not have.
fn bounded(x: f32) -> f32 {
    if (abs(x) < 0.3) {
        let y = x * x;
        return x * (1.0 + y * (-1.0 / 3.0 + y * (2.0 / 15.0 + y * (-17.0 / 315.0 + y * (62.0 / 2835.0)))));
    }
    return 1.0 - 2.0 / (exp(2.0 * clamp(x, -20.0, 20.0)) + 1.0);
}

fn bounded3(v: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(bounded(v.x), bounded(v.y), bounded(v.z));
}

// Coefficients of the exponential and of the left Jacobian (Barfoot eq. 8.91) as functions of the squared angle.
struct Series {
    sine: f32,    // sin a / a
    cosine: f32,  // (1 - cos a) / a^2
    second: f32,  // (a - sin a) / a^3
    third: f32,   // (a^2 + 2 cos a - 2) / (2 a^4)
    fourth: f32,  // (2 a - 3 sin a + a cos a) / (2 a^5)
}

fn series(s: f32) -> Series {
    if (s < 1.0) {
        return Series(
            1.0 + s * (-1.0 / 6.0 + s * (1.0 / 120.0 + s * (-1.0 / 5040.0 + s * (1.0 / 362880.0)))),
            0.5 + s * (-1.0 / 24.0 + s * (1.0 / 720.0 + s * (-1.0 / 40320.0 + s * (1.0 / 3628800.0)))),
            1.0 / 6.0 + s * (-1.0 / 120.0 + s * (1.0 / 5040.0 + s * (-1.0 / 362880.0 + s * (1.0 / 39916800.0)))),
            1.0 / 24.0 + s * (-1.0 / 720.0 + s * (1.0 / 40320.0 + s * (-1.0 / 3628800.0))),
            1.0 / 120.0 + s * (-1.0 / 2520.0 + s * (1.0 / 120960.0 + s * (-1.0 / 9979200.0))),
        );
    }
    let a = sqrt(s);
    let sin_a = sin(a);
    let cos_a = cos(a);
    return Series(
        sin_a / a,
        (1.0 - cos_a) / s,
        (a - sin_a) / (s * a),
        (s + 2.0 * cos_a - 2.0) / (2.0 * s * s),
        (2.0 * a - 3.0 * sin_a + a * cos_a) / (2.0 * s * s * a),
    );
}

// v + x (phi x v) + y (phi x (phi x v)): a rotation or its Jacobian, by its two coefficients.
fn turn(phi: vec3<f32>, v: vec3<f32>, x: f32, y: f32) -> vec3<f32> {
    let once = cross(phi, v);
    return v + x * once + y * cross(phi, once);
}

// Transpose of Barfoot's Q_l times x.
fn coupling_transposed(rho: vec3<f32>, phi: vec3<f32>, c: Series, x: vec3<f32>) -> vec3<f32> {
    let p = cross(rho, x);
    let f = cross(phi, x);
    let pf = cross(rho, f);
    let fp = cross(phi, p);
    let ff = cross(phi, f);
    let fpf = cross(phi, pf);
    let ffp = cross(phi, fp);
    let pff = cross(rho, ff);
    return -0.5 * p + c.second * (pf + fp - fpf) + c.third * (3.0 * fpf - pff - ffp)
        + c.fourth * (cross(phi, fpf) + cross(phi, pff));
}
