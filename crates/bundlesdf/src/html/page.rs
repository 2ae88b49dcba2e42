//! The page itself.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::{
    gather::Results,
    losses::{loss_plot, rounds_table},
    plot::quantile,
    sphere::keyframe_map,
    story::{Story, story},
    timeline::timeline,
};
use crate::{
    report::{FrameReport, RunReport},
    tracker::Status,
};

const STYLE: &str = include_str!("../../assets/report/report.css");
const SCRIPT: &str = include_str!("../../assets/report/report.js");
/// three.js with a loader and controls; how it is built and its licence stand in its folder.
const VIEWER: &str = include_str!("../../assets/viewer/viewer.min.js");
/// The browser itself refuses every request to the network.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
                      img-src data: blob:; connect-src data: blob:";

pub(super) fn render(results: &Results) -> String {
    let report = &results.report;
    let name = report.input.as_ref().map_or_else(|| "results".to_owned(), |input| input.name());
    let story = story(results);
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta http-equiv="Content-Security-Policy" content=(POLICY);
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (name) " \u{2013} bundlesdf" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main {
                    (head(&name, report, &story))
                    (tiles(results))
                    (advice(&story))
                    (model(results))
                    (over_time(report))
                    (poses(results))
                    (field(report))
                    (timings(report))
                    (files(results))
                    (config(report))
                }
                footer {
                    p { "Written by bundlesdf " (report.version) ". The 3-D view is three.js (MIT licence, text in the page's source)." }
                }
                script { (PreEscaped(SCRIPT)) }
                @if let Some(model) = &results.model {
                    script type="model/gltf-binary" id="model" data-up="y" {
                        (PreEscaped(model))
                    }
                    script { (PreEscaped(VIEWER)) }
                }
            }
        }
    }
    .into_string()
}

fn head(name: &str, report: &RunReport, story: &Story) -> Markup {
    let schedule = format!("{:?}", report.schedule).to_lowercase();
    html! {
        header {
            p.eyebrow { "Tracking and reconstruction report" }
            h1 { (name) }
            p.verdict {
                span class={ "chip " (story.verdict.class()) } { (story.verdict.word()) }
                @for sentence in &story.sentences { (sentence) " " }
            }
            p.meta {
                (report.frames.len()) " frames \u{b7} " (schedule) " schedule \u{b7} "
                (duration(report.wall_s)) " in all \u{b7} bundlesdf " (report.version)
            }
        }
    }
}

/// Seconds as a person says them.
fn duration(seconds: f64) -> String {
    if seconds < 120.0 {
        format!("{seconds:.1} s")
    } else {
        format!("{:.0} min {:.0} s", (seconds / 60.0).floor(), seconds % 60.0)
    }
}

fn tile(value: &str, unit: &str, what: &str) -> Markup {
    html! { div.tile.wide[value.len() > 12] { dd { (value) @if !unit.is_empty() { small { " " (unit) } } } dt { (what) } } }
}

fn tiles(results: &Results) -> Markup {
    let report = &results.report;
    let total = report.frames.len();
    let found = report.count(Status::Tracked) + report.count(Status::Relocalised);
    let percent = if total == 0 { 0.0 } else { 100.0 * found as f64 / total as f64 };
    // What the page shows is the refinement's, if there was one.
    let scores = results.refined_scores.or(results.scores);
    let online = results.refined_scores.and(results.scores);
    let against = |what: &str, before: Option<String>| match before {
        Some(before) => format!("{what} against the truth; {before} while the video ran"),
        None => format!("{what} against the truth"),
    };
    html! {
        dl.tiles {
            (tile(&format!("{percent:.0}"), "%", &format!("of frames tracked, {} weak, {} lost",
                report.count(Status::Weak), report.count(Status::Lost))))
            (tile(&report.keyframes.to_string(), "", "keyframes in memory"))
            @match results.size_cm() {
                Some([a, b, c]) => (tile(&format!("{a:.1} \u{d7} {b:.1} \u{d7} {c:.1}"), "cm", "size of the mesh (smallest box)")),
                None => (tile("\u{2013}", "", "no mesh")),
            }
            @if report.mesh.faces > 0 {
                (tile(&thousands(report.mesh.faces), "faces",
                    if report.mesh.watertight { "watertight" } else { "open where nothing was seen" }))
            }
            (tile(&format!("{:.1}", report.tracking_hz_median), "Hz", "tracking, median frame"))
            @if let Some(scores) = scores {
                (tile(&format!("{:.1}", scores.add), "%", &against("ADD AUC", online.map(|s| format!("{:.1}", s.add)))))
                (tile(&format!("{:.1}", scores.add_s), "%", &against("ADD-S AUC", online.map(|s| format!("{:.1}", s.add_s)))))
                @if let Some(cd) = scores.cd_cm {
                    (tile(&format!("{cd:.2}"), "cm",
                        &against("chamfer distance", online.and_then(|s| s.cd_cm).map(|cd| format!("{cd:.2}")))))
                }
            }
        }
    }
}

/// 1234567 as 1 234 567, with narrow spaces.
fn thousands(number: usize) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push('\u{202f}');
        }
        text.push(digit);
    }
    text
}

fn advice(story: &Story) -> Markup {
    html! {
        @if !story.advice.is_empty() {
            section.advice {
                h2 { "What to look at" }
                ul { @for item in &story.advice { li { strong { (item.problem) } " " (item.remedy) } } }
            }
        }
    }
}

fn model(results: &Results) -> Markup {
    html! {
        section {
            h2 { "The object" }
            div.pair {
                figure #viewer class=[results.model.is_none().then_some("off")] {
                    @if results.model.is_some() {
                        div.stage {
                            canvas #view aria-label="The reconstructed mesh; drag to turn it" {}
                            p #view-note hidden {}
                        }
                        div.tools {
                            button #view-home type="button" { "Reset" }
                            button #view-turn type="button" aria-pressed="false" { "Turn" }
                            button #view-clay type="button" aria-pressed="false" { "Shape only" }
                            button #view-wire type="button" aria-pressed="false" { "Wires" }
                            button #view-axes type="button" aria-pressed="false" { "Axes" }
                        }
                        noscript { "The 3-D view needs JavaScript; open mesh.ply in a mesh viewer instead." }
                    } @else {
                        div.stage { p #view-note { "There is no mesh to show." } }
                    }
                    figcaption { "Drag to turn, scroll to zoom, right-drag to move. The grid's lines are 5 cm apart." }
                }
                figure {
                    (keyframe_map(results))
                    figcaption {
                        "Each dot is a keyframe, pale to strong from first to last, where its camera stood around the "
                        "object; the line is the way of the camera. Rings are 30\u{b0} apart, areas are true to scale. "
                        "Sides without dots were not seen."
                    }
                }
            }
        }
    }
}

fn over_time(report: &RunReport) -> Markup {
    html! {
        @if !report.frames.is_empty() {
            section {
                h2 { "Frame by frame" }
                p.legend {
                    @for status in [Status::Tracked, Status::Relocalised, Status::Weak, Status::Lost] {
                        span { i class={ "swatch " (status.as_str()) } {} (status.as_str()) " " (report.count(status)) }
                    }
                    span { i.triangle {} "keyframe " (report.frames.iter().filter(|f| f.keyframe).count()) }
                }
                (timeline(report))
            }
        }
    }
}

fn poses(results: &Results) -> Markup {
    let overlays = &results.overlays;
    html! {
        @if !(overlays.pictures.is_empty() && overlays.problem.is_none()) {
            section {
                h2 { "Poses on the frames" }
                p.lead {
                    "White: the box around the mesh (dashed behind it). Yellow: outline of the mesh, also where "
                    "something hides it. Red, green, blue: x, y, z of the object. The outline should lie on the object's edge. "
                    "Each picture shows the part of its frame around the object."
                    @if results.refined { " Mesh and poses are those after the refinement; status and inliers are the run's." }
                }
                @if let Some(problem) = &overlays.problem { p.note { (problem) } }
                div.frames {
                    @for picture in &overlays.pictures {
                        @if let Some(entry) = results.report.frames.get(picture.frame) {
                            figure {
                                img src=(picture.uri) width=(picture.width) height=(picture.height)
                                    alt=(format!("frame {} with the projected box and axes", entry.id));
                                figcaption { (caption(entry)) }
                            }
                        }
                    }
                }
            }
        }
    }
}

fn caption(entry: &FrameReport) -> Markup {
    html! {
        b { (entry.id) }
        span { i class={ "swatch " (entry.status.as_str()) } {} (entry.status.as_str()) }
        span { (entry.inliers) " inliers" }
        span { (format!("{:.0} % of depth fits", entry.depth_agreement * 100.0)) }
    }
}

fn field(report: &RunReport) -> Markup {
    let rounds = &report.field.history;
    html! {
        @if !rounds.is_empty() {
            section {
                h2 { "Neural Object Field" }
                p.lead {
                    "Each round trains the object's shape and colour on the keyframes so far and corrects their poses; "
                    "the last one makes the mesh. A curve that ends much higher than its neighbours points at bad masks or poses."
                }
                @match loss_plot(rounds) {
                    Some(plot) => (plot),
                    None => p.note { "The rounds solved a pose graph; nothing was trained." },
                }
                details { summary { "Rounds in numbers" } (rounds_table(rounds)) }
            }
        }
    }
}

fn timings(report: &RunReport) -> Markup {
    type Stage = fn(&FrameReport) -> f64;
    let stages: [(&str, Stage); 4] = [
        ("segmentation", |f| f.ms.segment),
        ("depth, matching, RANSAC", |f| f.ms.matching),
        ("pose graph", |f| f.ms.posegraph),
        ("whole frame", |f| f.ms.total),
    ];
    html! {
        section {
            h2 { "Timings" }
            div.scroll {
                table {
                    thead { tr { th { "stage" } th { "median" } th { "95 %" } th { "slowest" } } }
                    tbody {
                        @for (name, stage) in stages {
                            tr {
                                th scope="row" { (name) }
                                @for share in [0.5, 0.95, 1.0] {
                                    td { (format!("{:.1} ms", quantile(report.frames.iter().map(stage), share))) }
                                }
                            }
                        }
                        tr {
                            th scope="row" { "field, one round of " (report.field.steps) " steps" }
                            td { (format!("{:.2} s", report.field.ms_per_round_median / 1e3)) }
                            td {} td {}
                        }
                        tr { th scope="row" { "whole run" } td { (duration(report.wall_s)) } td {} td {} }
                    }
                }
            }
        }
    }
}

/// What the results folder may hold.
const FILES: [(&str, &str); 19] = [
    ("ob_in_cam", "pose of every frame: 4\u{d7}4, object to camera"),
    ("ob_in_cam_refined", "the poses after the refinement over all frames"),
    ("masks", "mask that each frame was tracked with"),
    ("draw", "frames with overlays (bundlesdf draw)"),
    ("mesh.ply", "mesh for MeshLab, Open3D, CloudCompare"),
    ("mesh.obj", "mesh for nearly every program"),
    ("mesh_online.ply", "the mesh before the refinement"),
    ("mesh.glb", "textured mesh for the web, Blender, game engines"),
    ("textured.obj", "textured mesh for nearly every program"),
    ("textured.ply", "mesh with confidence and number of observations"),
    ("mesh.stl", "shape for printing and CAD"),
    ("canonical.json", "where the upright, centred frame lies in the object frame"),
    ("sim", "bodies for simulators: URDF and MJCF"),
    ("export.json", "what the export did"),
    ("keyframes.json", "keyframes and their poses"),
    ("keyframes_refined.json", "keyframes and their poses after the refinement"),
    ("run.json", "everything on this page, for programs"),
    ("eval.json", "scores against the truth"),
    ("eval_refined.json", "scores against the truth after the refinement"),
];

fn files(results: &Results) -> Markup {
    let there = FILES.into_iter().filter(|(name, _)| results.files.iter().any(|f| f == name));
    html! {
        section {
            h2 { "Files and conventions" }
            table.plain {
                tbody { @for (name, what) in there { tr { th scope="row" { code { (name) } } td { (what) } } } }
            }
            p {
                "Lengths are metres. Cameras are OpenCV's: x right, y down, z forward. The object frame has the axes of "
                "the first camera and its origin in the middle of what the first frame saw; a pose maps its coordinates "
                "to the camera's."
            }
        }
    }
}

fn config(report: &RunReport) -> Markup {
    let text = toml::to_string_pretty(&report.config).unwrap_or_else(|e| format!("# can't be shown: {e}"));
    html! {
        section {
            h2 { "Configuration" }
            @if let Some(input) = &report.input {
                p.meta { "input " code { (serde_json::to_string(input).unwrap_or_default()) } }
            }
            details { summary { "Every setting of this run" } pre { (text) } }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_numbers_are_grouped() {
        assert_eq!(thousands(7), "7");
        assert_eq!(thousands(1_234_567), "1\u{202f}234\u{202f}567");
        assert_eq!(duration(61.04), "61.0 s");
        assert_eq!(duration(151.0), "2 min 31 s");
    }
}
