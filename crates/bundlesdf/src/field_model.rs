//! The trained field as the pose graph sees it.

use neural_field::TrainedField;
use posegraph::SdfModel;

/// Signed distances near the surface, nothing elsewhere.
pub(crate) struct FieldModel<'a>(pub(crate) &'a TrainedField);

impl SdfModel for FieldModel<'_> {
    fn sdf_and_gradient(&self, points: &[[f32; 3]], sdf: &mut [f32], gradient: &mut [[f32; 3]]) {
        self.0.sdf_and_gradient(points, sdf, gradient);
        // Beyond one truncation distance the field says "far" and not how far.
        let limit = self.0.truncation() as f32;
        for value in sdf.iter_mut().filter(|v| v.abs() > limit) {
            *value = f32::NAN;
        }
    }
}
