//! The output folder: every file is written under a temporary name and renamed, so that none is ever half there.

use std::{
    fs,
    path::{Path, PathBuf},
};

use marching_cubes::TriMesh;
use nalgebra::Isometry3;
use rgbd_io::{
    Error, Mask,
    poses::{format_pose, write_atomic},
};
use serde::{Serialize, de::DeserializeOwned};

use crate::{
    checkpoint,
    refine::Refined,
    report::{KeyframeReport, RunReport},
    tracker::Reconstruction,
};

const POSES: &str = "ob_in_cam";
const MASKS: &str = "masks";
const REFINED_POSES: &str = "ob_in_cam_refined";

/// Files directly in the folder that a run or a later step writes.
const FILES: [&str; 10] = [
    "run.json",
    "keyframes.json",
    "mesh.ply",
    "mesh.obj",
    "eval.json",
    "eval_refined.json",
    "report.html",
    "keyframes_refined.json",
    "mesh_online.ply",
    "mesh_online.obj",
];
/// Frames with overlays, as `bundlesdf draw` writes them.
const DRAWN: &str = "draw";

/// A folder that holds one run's results.
#[derive(Clone, Debug)]
pub struct OutputFolder {
    root: PathBuf,
}

impl OutputFolder {
    /// Makes the folder ready for a run.
    ///
    /// # Errors
    /// When it can't be created, or already holds a run and `replace` is not set. With `replace` the earlier run's
    /// files are removed, nothing else.
    pub fn create(root: &Path, replace: bool) -> Result<Self, Error> {
        let (poses, masks) = (root.join(POSES), root.join(MASKS));
        let earlier =
            poses.exists() || root.join("run.json").exists() || root.join("state/manifest.json").exists();
        if earlier && !replace {
            return Err(Error::new(
                root,
                "already holds the results of a run",
                "give another folder with --out, go on with a run that was stopped by --resume, or replace it with \
                 --force",
            ));
        }
        if checkpoint::is_in_use(root) {
            let remedy = "wait for it, end it, or give another folder with --out";
            return Err(Error::new(root, "is being written to by another run", remedy));
        }
        let failed = |path: &Path, problem: &std::io::Error| {
            Error::new(path, format!("can't be prepared ({problem})"), "choose a folder you may write to")
        };
        if earlier {
            remove_earlier_run(root).map_err(|e| failed(root, &e))?;
        }
        for dir in [&poses, &masks] {
            fs::create_dir_all(dir).map_err(|e| failed(dir, &e))?;
        }
        Ok(Self { root: root.to_owned() })
    }

    /// Opens the folder of a run that was stopped, to go on with it: what a killed process left half-written is
    /// removed.
    ///
    /// # Errors
    /// When a sub-folder is missing and can't be made.
    pub fn reopen(root: &Path) -> Result<Self, Error> {
        let failed = |path: &Path, problem: &std::io::Error| {
            Error::new(path, format!("can't be prepared ({problem})"), "choose a folder you may write to")
        };
        for dir in [root.join(POSES), root.join(MASKS)] {
            fs::create_dir_all(&dir).map_err(|e| failed(&dir, &e))?;
        }
        for dir in [root.to_owned(), root.join(POSES), root.join(MASKS), root.join("state")] {
            remove_temporary(&dir).map_err(|e| failed(&dir, &e))?;
        }
        Ok(Self { root: root.to_owned() })
    }

    /// The folder.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.root
    }

    /// Writes `ob_in_cam/<id>.txt`: 4x4, object to camera, metres.
    ///
    /// # Errors
    /// When the file can't be written.
    pub fn write_pose(&self, id: &str, cam_from_obj: &Isometry3<f64>) -> Result<(), Error> {
        let path = self.root.join(POSES).join(format!("{id}.txt"));
        write_atomic(&path, format_pose(cam_from_obj).as_bytes())
    }

    /// Writes `masks/<id>.png`: the mask that the frame was tracked with, white = object.
    ///
    /// # Errors
    /// When the file can't be written.
    pub fn write_mask(&self, id: &str, mask: &Mask) -> Result<(), Error> {
        rgbd_io::write_png_mask(&self.root.join(MASKS).join(format!("{id}.png")), mask)
    }

    /// Opens a folder that already holds a run's results.
    ///
    /// # Errors
    /// When there is no `run.json` in it.
    pub fn open(root: &Path) -> Result<Self, Error> {
        if root.join("run.json").is_file() {
            return Ok(Self { root: root.to_owned() });
        }
        let remedy = "give a folder that `bundlesdf run` or `bundlesdf demo` has written to the end";
        Err(Error::new(root, "holds no run.json", remedy))
    }

    /// Reads `run.json`.
    ///
    /// # Errors
    /// When it is missing or not of this version.
    pub fn read_report(&self) -> Result<RunReport, Error> {
        self.read_json("run.json")
    }

    /// Reads `keyframes.json`.
    ///
    /// # Errors
    /// When it is missing or not of this version.
    pub fn read_keyframes(&self) -> Result<Vec<KeyframeReport>, Error> {
        self.read_json("keyframes.json")
    }

    /// Reads `keyframes_refined.json`; `None` when the run was not refined.
    ///
    /// # Errors
    /// When it is there and damaged.
    pub fn read_refined_keyframes(&self) -> Result<Option<Vec<KeyframeReport>>, Error> {
        let name = "keyframes_refined.json";
        if self.root.join(name).is_file() { self.read_json(name).map(Some) } else { Ok(None) }
    }

    /// Reads `ob_in_cam/<id>.txt`: `cam_from_obj`.
    ///
    /// # Errors
    /// When it is missing or not a pose.
    pub fn read_pose(&self, id: &str) -> Result<Isometry3<f64>, Error> {
        rgbd_io::poses::read_pose(&self.root.join(POSES).join(format!("{id}.txt")))
    }

    /// The pose that goes with `mesh.ply`: of `ob_in_cam_refined/` where the run was refined, else of `ob_in_cam/`.
    ///
    /// # Errors
    /// When it is missing or not a pose.
    pub fn read_final_pose(&self, id: &str) -> Result<Isometry3<f64>, Error> {
        let refined = self.root.join(REFINED_POSES).join(format!("{id}.txt"));
        if refined.is_file() { rgbd_io::poses::read_pose(&refined) } else { self.read_pose(id) }
    }

    /// Reads `masks/<id>.png`.
    ///
    /// # Errors
    /// When it is missing or not an image.
    pub fn read_mask(&self, id: &str) -> Result<Mask, Error> {
        rgbd_io::read_mask(&self.root.join(MASKS).join(format!("{id}.png")))
    }

    /// Reads `mesh.ply`; `None` when the run made no mesh.
    ///
    /// # Errors
    /// When it is there and damaged.
    pub fn read_mesh(&self) -> Result<Option<TriMesh>, Error> {
        self.read_ply("mesh.ply")
    }

    /// Reads the mesh from before a refinement; `None` when there is none.
    ///
    /// # Errors
    /// When it is there and damaged.
    pub fn read_online_mesh(&self) -> Result<Option<TriMesh>, Error> {
        self.read_ply("mesh_online.ply")
    }

    fn read_ply(&self, name: &str) -> Result<Option<TriMesh>, Error> {
        let path = self.root.join(name);
        if !path.exists() {
            return Ok(None);
        }
        let damaged =
            |problem: String| Error::new(&path, format!("can't be read ({problem})"), "run the video again");
        let bytes = fs::read(&path).map_err(|e| damaged(e.to_string()))?;
        marching_cubes::read_ply(&bytes).map(Some).map_err(|e| damaged(e.to_string()))
    }

    /// The folder of the frames that `bundlesdf draw` writes.
    #[must_use]
    pub fn drawn(&self) -> PathBuf {
        self.root.join(DRAWN)
    }

    fn read_json<T: DeserializeOwned>(&self, name: &str) -> Result<T, Error> {
        let path = self.root.join(name);
        let text = fs::read_to_string(&path)
            .map_err(|e| Error::new(&path, format!("can't be read ({e})"), "run the video again"))?;
        serde_json::from_str(&text).map_err(|e| {
            let problem = format!("isn't what this version writes ({e})");
            Error::new(&path, problem, "run the video again with this version")
        })
    }

    /// Writes `mesh.obj`, `mesh.ply` (when there is a mesh) and `keyframes.json`.
    ///
    /// # Errors
    /// When a file can't be written.
    pub fn write_reconstruction(&self, reconstruction: &Reconstruction) -> Result<(), Error> {
        if let Some(mesh) = &reconstruction.mesh {
            self.write_mesh("mesh.ply", mesh, marching_cubes::write_ply)?;
            self.write_mesh("mesh.obj", mesh, marching_cubes::write_obj)?;
        }
        let keyframes: Vec<_> = reconstruction.keyframes.iter().map(KeyframeReport::of).collect();
        self.write_json("keyframes.json", &keyframes)
    }

    /// Writes what a refinement found: `ob_in_cam_refined/<id>.txt`, `keyframes_refined.json`, `mesh.ply` and
    /// `mesh.obj`. The run's own results stay, its mesh as `mesh_online.ply` and `mesh_online.obj`.
    ///
    /// # Errors
    /// When a file can't be written.
    pub fn write_refined(&self, refined: &Refined) -> Result<(), Error> {
        let dir = self.root.join(REFINED_POSES);
        fs::create_dir_all(&dir).map_err(|e| {
            Error::new(&dir, format!("can't be prepared ({e})"), "choose a folder you may write to")
        })?;
        for frame in &refined.frames {
            let path = dir.join(format!("{}.txt", frame.id));
            write_atomic(&path, format_pose(&frame.cam_from_obj).as_bytes())?;
        }
        if !refined.mesh.triangles.is_empty() {
            self.keep_online("mesh.ply", "mesh_online.ply")?;
            self.keep_online("mesh.obj", "mesh_online.obj")?;
            self.write_mesh("mesh.ply", &refined.mesh, marching_cubes::write_ply)?;
            self.write_mesh("mesh.obj", &refined.mesh, marching_cubes::write_obj)?;
        }
        let keyframes: Vec<_> = refined.keyframes.iter().map(KeyframeReport::refined).collect();
        self.write_json("keyframes_refined.json", &keyframes)
    }

    /// Keeps a file of the run under another name, unless an earlier refinement has done so.
    fn keep_online(&self, name: &str, kept: &str) -> Result<(), Error> {
        let (from, to) = (self.root.join(name), self.root.join(kept));
        if to.exists() || !from.is_file() {
            return Ok(());
        }
        let bytes = fs::read(&from).map_err(|e| {
            Error::new(&from, format!("can't be read ({e})"), "choose a folder you may read and write")
        })?;
        write_atomic(&to, &bytes)
    }

    /// Writes `run.json`.
    ///
    /// # Errors
    /// When the file can't be written.
    pub fn write_report(&self, report: &RunReport) -> Result<(), Error> {
        self.write_json("run.json", report)
    }

    /// Writes any value as JSON under `name`.
    ///
    /// # Errors
    /// When the file can't be written.
    pub fn write_json(&self, name: &str, value: &impl Serialize) -> Result<(), Error> {
        let path = self.root.join(name);
        let mut text = serde_json::to_vec_pretty(value).map_err(|e| {
            Error::new(&path, format!("can't be put into JSON ({e})"), "report this as a bug")
        })?;
        text.push(b'\n');
        write_atomic(&path, &text)
    }

    fn write_mesh(
        &self,
        name: &str,
        mesh: &TriMesh,
        write: impl Fn(&TriMesh, &mut Vec<u8>) -> std::io::Result<()>,
    ) -> Result<(), Error> {
        let path = self.root.join(name);
        let mut bytes = Vec::new();
        write(mesh, &mut bytes)
            .map_err(|e| Error::new(&path, format!("can't be written ({e})"), "report this as a bug"))?;
        write_atomic(&path, &bytes)
    }
}

/// Removes files that were not renamed to their own name before the process ended (see [`write_atomic`]).
fn remove_temporary(dir: &Path) -> std::io::Result<()> {
    if !dir.is_dir() {
        return Ok(());
    }
    for entry in fs::read_dir(dir)? {
        let entry = entry?;
        if entry.file_name().to_str().is_some_and(is_temporary) {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

/// `.<name>.<process>.<number>.tmp`
fn is_temporary(name: &str) -> bool {
    let is_number = |part: Option<&str>| part.is_some_and(|p| p.parse::<u64>().is_ok());
    let mut parts = name.rsplit('.');
    name.starts_with('.')
        && parts.next() == Some("tmp")
        && is_number(parts.next())
        && is_number(parts.next())
        && parts.next().is_some_and(|name| !name.is_empty())
}

/// Removes what an earlier run wrote under its own names.
fn remove_earlier_run(root: &Path) -> std::io::Result<()> {
    for dir in
        [root.to_owned(), root.join(POSES), root.join(REFINED_POSES), root.join(MASKS), root.join("state")]
    {
        remove_temporary(&dir)?;
    }
    checkpoint::remove_from(root)?;
    for (dir, kind) in [(POSES, "txt"), (REFINED_POSES, "txt"), (MASKS, "png"), (DRAWN, "png")] {
        let dir = root.join(dir);
        if !dir.is_dir() {
            continue;
        }
        for entry in fs::read_dir(dir)? {
            let path = entry?.path();
            if path.extension().is_some_and(|e| e == kind) {
                fs::remove_file(path)?;
            }
        }
    }
    if root.join(crate::export::SIM).join("object.urdf").is_file() {
        fs::remove_dir_all(root.join(crate::export::SIM))?;
    }
    for name in FILES.into_iter().chain(crate::export::FILES) {
        match fs::remove_file(root.join(name)) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_only_replaced_on_request_and_foreign_files_stay() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().join("out");
        let folder = OutputFolder::create(&root, false).unwrap();
        folder.write_pose("0001", &Isometry3::identity()).unwrap();
        fs::write(root.join("notes.txt"), "mine").unwrap();
        let error = OutputFolder::create(&root, false).unwrap_err().to_string();
        assert!(error.contains("--force") && error.contains("out"), "{error}");
        OutputFolder::create(&root, true).unwrap();
        assert!(!root.join("ob_in_cam/0001.txt").exists());
        assert_eq!(fs::read_to_string(root.join("notes.txt")).unwrap(), "mine");
    }

    #[test]
    fn an_unwritable_place_is_an_error_with_its_path() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        fs::write(&file, "x").unwrap();
        let error = OutputFolder::create(&file, false).unwrap_err().to_string();
        assert!(error.contains("file"), "{error}");
    }
}
