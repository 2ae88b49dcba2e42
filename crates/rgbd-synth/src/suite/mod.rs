//! Thirteen sequences, each of which makes one thing hard.

mod motions;
mod objects;
mod scenes;
mod solids;
mod variant;

use crate::{Sequence, SequenceSpec};

/// One sequence of the suite.
struct Entry {
    name: &'static str,
    stresses: &'static str,
    build: fn() -> SequenceSpec,
}

const SUITE: [Entry; 13] = [
    Entry {
        name: "texture-less",
        stresses: "no print: one colour, so only shading and depth can be matched",
        build: scenes::texture_less,
    },
    Entry {
        name: "symmetric",
        stresses: "a surface of revolution without print: the turn about its axis can't be seen",
        build: scenes::symmetric,
    },
    Entry {
        name: "thin-structure",
        stresses: "wires of 4 to 5 mm: few pixels, frayed masks, missing depth",
        build: scenes::thin_structure,
    },
    Entry {
        name: "specular",
        stresses: "highlights and mirror images that don't move with the surface, and no depth where they glare",
        build: scenes::specular,
    },
    Entry {
        name: "fast-motion",
        stresses: "shaking by up to 9 degrees and 3 cm a frame, with motion blur",
        build: scenes::fast_motion,
    },
    Entry {
        name: "partial-occlusion",
        stresses: "rods and a card that swing in front and with the hand hide almost half of it, at most three quarters",
        build: scenes::partial_occlusion,
    },
    Entry {
        name: "total-occlusion",
        stresses: "nothing to be seen for over 60 frames; the object comes back turned by 45 degrees",
        build: scenes::total_occlusion,
    },
    Entry {
        name: "noisy-masks",
        stresses: "masks with false and missing pieces, wavering boundaries and some empty ones: mean J about 0.8",
        build: scenes::noisy_masks,
    },
    Entry {
        name: "depth-noise",
        stresses: "three times the depth noise, part of it correlated, and a fifth of the depth missing",
        build: scenes::depth_noise,
    },
    Entry {
        name: "small-far",
        stresses: "a toy of 8 cm at 1.15 m: 500 to 1200 pixels",
        build: scenes::small_far,
    },
    Entry {
        name: "large-near",
        stresses: "a kettle of 24 cm at 0.46 m: a fifth of the image, often near its border",
        build: scenes::large_near,
    },
    Entry {
        name: "in-hand-turn",
        stresses: "a full turn in the hand: drift adds up, and the first view comes back",
        build: scenes::in_hand_turn,
    },
    Entry {
        name: "moving-camera",
        stresses: "the object stands still and the camera goes around it: the background moves along",
        build: scenes::moving_camera,
    },
];

impl Sequence {
    /// Names of the suite's thirteen sequences: 640 x 480, 200 to 300 frames each, every one named after what it
    /// stresses. [`Sequence::named`] builds them.
    pub fn suite() -> impl ExactSizeIterator<Item = &'static str> {
        SUITE.iter().map(|e| e.name)
    }

    /// The sequence of the suite with this name (or with underscores in place of the hyphens); `None` for other
    /// names. Always the same one: poses, meshes, pixels.
    pub fn named(name: &str) -> Option<Self> {
        let entry = entry(name)?;
        Some(Self::from_spec(SequenceSpec { name: entry.name.into(), ..(entry.build)() }))
    }

    /// What the sequence of the suite with this name makes hard, in a sentence.
    pub fn stresses(name: &str) -> Option<&'static str> {
        entry(name).map(|e| e.stresses)
    }
}

fn entry(name: &str) -> Option<&'static Entry> {
    let hyphened = name.replace('_', "-");
    SUITE.iter().find(|e| e.name == hyphened)
}
