// Trilinear interpolation on one lattice of the feature grid (grid.rs). Expects a module variable
// `table: array<vec2<f32>>` with the two features of every vertex of all lattices.

// x: vertices per axis, y: first vertex in the table, z: hash mask or 0 for a dense lattice, w: scale (bits of f32).
alias Level = vec4<u32>;

struct Cell {
    // Vertices along x for (y, z) = (0, 0), (1, 0), (0, 1), (1, 1).
    rows: array<vec2<u32>, 4>,
    frac: vec3<f32>,
}

fn cell_around(level: Level, p: vec3<f32>) -> Cell {
    let x = p * bitcast<f32>(level.w) + 0.5;
    let cell = clamp(vec3<i32>(x), vec3<i32>(0), vec3<i32>(i32(level.x) - 2));
    let c = vec3<u32>(cell);
    var out: Cell;
    out.frac = x - vec3<f32>(cell);
    if (level.z == 0u) {
        let n = level.x;
        let base = level.y + (c.z * n + c.y) * n + c.x;
        out.rows[0] = vec2<u32>(base, base + 1u);
        out.rows[1] = out.rows[0] + n;
        out.rows[2] = out.rows[0] + n * n;
        out.rows[3] = out.rows[2] + n;
    } else {
        let y = vec2<u32>(c.y, c.y + 1u) * 2654435761u;
        let z = vec2<u32>(c.z, c.z + 1u) * 805459861u;
        let side = vec2<u32>(c.x, c.x + 1u);
        out.rows[0] = level.y + ((side ^ vec2<u32>(y.x ^ z.x)) & vec2<u32>(level.z));
        out.rows[1] = level.y + ((side ^ vec2<u32>(y.y ^ z.x)) & vec2<u32>(level.z));
        out.rows[2] = level.y + ((side ^ vec2<u32>(y.x ^ z.y)) & vec2<u32>(level.z));
        out.rows[3] = level.y + ((side ^ vec2<u32>(y.y ^ z.y)) & vec2<u32>(level.z));
    }
    return out;
}

// Features of the two vertices of every row.
fn cell_features(cell: Cell) -> array<vec4<f32>, 4> {
    return array<vec4<f32>, 4>(
        vec4<f32>(table[cell.rows[0].x], table[cell.rows[0].y]),
        vec4<f32>(table[cell.rows[1].x], table[cell.rows[1].y]),
        vec4<f32>(table[cell.rows[2].x], table[cell.rows[2].y]),
        vec4<f32>(table[cell.rows[3].x], table[cell.rows[3].y]),
    );
}

// Values of the two features and their derivatives by the position in the unit cube.
struct Interpolated {
    value: vec2<f32>,
    by_x: vec2<f32>,
    by_y: vec2<f32>,
    by_z: vec2<f32>,
}

fn interpolate(level: Level, r: array<vec4<f32>, 4>, frac: vec3<f32>) -> Interpolated {
    let scale = bitcast<f32>(level.w);
    let d0 = r[1] - r[0];
    let d1 = r[3] - r[2];
    let y0 = r[0] + frac.y * d0;
    let y1 = r[2] + frac.y * d1;
    let dz = y1 - y0;
    let row = y0 + frac.z * dz;
    let dy = d0 + frac.z * (d1 - d0);
    let dx = row.zw - row.xy;
    return Interpolated(
        row.xy + frac.x * dx,
        scale * dx,
        scale * (dy.xy + frac.x * (dy.zw - dy.xy)),
        scale * (dz.xy + frac.x * (dz.zw - dz.xy)),
    );
}

// Mixed second derivatives of the two features; the pure ones are zero.
struct Mixed {
    xy: vec2<f32>,
    xz: vec2<f32>,
    yz: vec2<f32>,
}

fn mixed_derivatives(level: Level, r: array<vec4<f32>, 4>, frac: vec3<f32>) -> Mixed {
    let scale = bitcast<f32>(level.w);
    let d0 = r[0].zw - r[0].xy;
    let d1 = r[1].zw - r[1].xy;
    let d2 = r[2].zw - r[2].xy;
    let d3 = r[3].zw - r[3].xy;
    let twist = (r[3] - r[2]) - (r[1] - r[0]);
    let square = scale * scale;
    return Mixed(
        square * ((d1 - d0) + frac.z * ((d3 - d2) - (d1 - d0))),
        square * ((d2 - d0) + frac.y * ((d3 - d1) - (d2 - d0))),
        square * (twist.xy + frac.x * (twist.zw - twist.xy)),
    );
}
