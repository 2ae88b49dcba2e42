//! Evaluation of a trained field at arbitrary points, in blocks of lanes.

use crate::color::{color_features, color_forward, view_forward, view_in};
use crate::eikonal::{slope_factors, slope_weights};
use crate::harmonics::harmonics;
use crate::pass::{encode, hidden_layer, through_jacobian};
use crate::real::{Isa, Kernel, Real};
use crate::tile::{Aligned, Model, PANEL, Panel, Scratch};

/// Distances of `lanes` points in `pos[axis][lane]`, and slopes (per edge of the cube) if `SLOPES`.
pub(crate) struct Query<'a, R, const SLOPES: bool> {
    pub(crate) model: &'a Model<'a, R>,
    pub(crate) lanes: usize,
    pub(crate) pos: &'a [R],
    pub(crate) scratch: &'a mut Scratch<R>,
}

impl<R: Real, const SLOPES: bool> Kernel for Query<'_, R, SLOPES> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        let Self { model, lanes, pos, scratch: s } = self;
        let e = model.networks.encoding();
        if SLOPES {
            slope_weights(model, &mut s.slope_weights);
        }
        for panel in Panel::all(lanes, lanes) {
            encode::<R, I, SLOPES>(model, (pos, lanes), panel, s);
            hidden_layer::<R, I>(model, panel, 0, s);
            if SLOPES {
                let mut v = std::mem::replace(&mut s.panel.columns, Aligned::zeros(0));
                slope_factors::<R, I>(model, panel, 0, s, (&mut v, PANEL));
                through_jacobian::<R, I>(
                    (&s.jac[panel.of(3 * e)], panel.width),
                    model.grid.width(),
                    (&v, PANEL),
                    (&mut s.d_pos[panel.start..], lanes),
                );
                s.panel.columns = v;
            }
        }
    }
}

/// Colours of `lanes` points seen along the unit directions `dirs[lane]`; [`Query`] must have run on them.
pub(crate) struct QueryColor<'a, R> {
    pub(crate) model: &'a Model<'a, R>,
    pub(crate) lanes: usize,
    pub(crate) dirs: &'a [[R; 3]],
    pub(crate) scratch: &'a mut Scratch<R>,
}

impl<R: Real> Kernel for QueryColor<'_, R> {
    #[inline(always)]
    fn run<I: Isa>(self) {
        let Self { model, lanes, dirs, scratch: s } = self;
        let code = model.networks.codes.neutral();
        for panel in Panel::all(lanes, lanes) {
            let dirs = &dirs[panel.start..][..panel.width];
            for (row, d) in dirs.iter().enumerate() {
                view_in(model, row, &harmonics(*d).0, code.clone(), s);
            }
            view_forward::<R, I>(model, panel.width, s);
            color_features::<R, I>(model, panel, 0, s);
            color_forward::<R, I>(model, panel, 0, panel.width, s);
        }
    }
}
