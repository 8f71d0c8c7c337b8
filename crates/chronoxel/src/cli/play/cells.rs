//! `play` for cells: the next step is decoded while this one is drawn.

use std::{
    io::Write,
    time::{Duration, Instant},
};

use anyhow::Context;
use chronoxel_render::ReadBack;

use super::{Cameras, FrameTime, LateArg, PlayArgs, PlayReport, Switch};
use crate::{
    cli::{
        WrongUsage,
        args::Common,
        cells::{CellReport, ChosenMethod},
        output,
    },
    player::{CameraPath, CellPlayer, CellPlayerOptions, Late},
    process::resource_usage,
    progress::{Counted, Progress},
    session::CellShot,
};

/// A frame of cells as it was measured.
struct CellFrame {
    time: FrameTime,
    misordered: u64,
    faces_chosen: usize,
    lod: f64,
}

impl PlayArgs {
    pub(super) fn play_cells(&self, common: &Common, method: ChosenMethod) -> anyhow::Result<PlayReport> {
        self.check_for_cells()?;
        let (session, backend, mut cells) =
            self.view.open_cells(&self.store, common, self.target_fps.is_some())?;
        let steps = self.order_of_steps(session.store().header().num_steps_finished as usize)?;
        let num_frames = self.frames.map_or(steps.len(), |n| n as usize);
        let shot = self.view.cell_shot(&session)?;
        let cameras = match &self.path {
            Some(path) => Cameras::Path(CameraPath::read(path)?),
            None if self.orbit != 0.0 => Cameras::Orbit(self, session.bounds()),
            None => Cameras::Still,
        };
        let options = CellPlayerOptions {
            target_fps: self.target_fps,
            late: if self.late == LateArg::Drop { Late::Drop } else { Late::Wait },
            throttle: self.throttle.map(|rate| rate.0 as f64),
            redraws: true,
            read_back: ReadBack::Bytes,
            loops: num_frames > steps.len(),
        };
        let mut player = CellPlayer::new(session, steps.iter().map(|step| *step as u32).collect(), options)?;
        let shot_of = |frame: usize| {
            let camera = cameras.camera(shot.camera, shot.size, frame, num_frames)?;
            anyhow::Ok(CellShot { camera, ..shot.clone() })
        };
        if self.warm == Switch::On {
            player.frame(&shot_of(0)?, 0)?;
            player.rewind();
        }
        let bytes_before = player.session().bytes_from_disk();
        let bar =
            Progress::new("play", num_frames as u64, Counted::Items("frames"), common.quiet || common.json);
        let mut frames = Vec::with_capacity(num_frames);
        for frame in 0..num_frames {
            crate::interrupt::check()?;
            let (timed, place) = self.timed_cells(&mut player, &shot_of(frame)?, &mut cells)?;
            let time = FrameTime { step: steps[place % steps.len()] as u32, ..timed.time };
            frames.push(CellFrame { time, ..timed });
            bar.advance(1);
        }
        bar.finish();
        let warnings: Vec<String> = cells.warning().into_iter().collect();
        warnings.iter().for_each(|warning| output::warning(warning));
        if let Some(path) = &self.csv {
            write_csv(path, &frames).with_context(|| format!("{}: cannot write", path.display()))?;
        }
        let times: Vec<FrameTime> = frames.into_iter().map(|frame| frame.time).collect();
        Ok(PlayReport {
            method: method.name,
            method_reason: method.reason,
            backend: backend.name,
            adapter: backend.adapter,
            backend_reason: backend.reason,
            bytes_from_disk: player.session().bytes_from_disk() - bytes_before,
            payload_bytes_peak: player.bytes_ahead_peak(),
            payload_bytes_budget: player.bytes_ahead_budget(),
            peak_rss_bytes: resource_usage().map(|usage| usage.peak_rss_bytes),
            size: shot.size,
            cells: Some(cells),
            warnings,
            ..PlayReport::of_frames(&times)
        })
    }

    fn check_for_cells(&self) -> anyhow::Result<()> {
        let of_bricks =
            [("--image-cache", self.image_cache.0 > 0), ("--upload-limit", self.upload_limit.is_some())];
        match of_bricks.iter().find(|(_, given)| *given) {
            Some((option, _)) => {
                Err(WrongUsage(format!("{option} is for bricks: leave it out with --method cells")).into())
            }
            None => Ok(()),
        }
    }

    /// Plays the next frame; also gives its place.
    fn timed_cells(
        &self,
        player: &mut CellPlayer,
        shot: &CellShot,
        cells: &mut CellReport,
    ) -> anyhow::Result<(CellFrame, usize)> {
        let cpu_secs = || resource_usage().map_or(0.0, |usage| usage.cpu_secs);
        let (start, cpu_start) = (Instant::now(), cpu_secs());
        let played = player.next(shot)?;
        let picture = played.picture.context("every frame is drawn")?;
        cells.add(&picture, played.fraction);
        let cpu_ms = (cpu_secs() - cpu_start) * 1e3;
        if let Some(fps) = self.target_fps {
            // A frame that is ready early is shown on time.
            std::thread::sleep(Duration::from_secs_f64(1.0 / fps).saturating_sub(start.elapsed()));
        }
        let time = FrameTime {
            frame_ms: start.elapsed().as_secs_f64() * 1e3,
            wait_ms: played.wait_ms,
            hits: u64::from(played.is_hit),
            misses: u64::from(!played.is_hit),
            num_dropped: played.num_dropped,
            is_late: played.is_late,
            num_drawn: picture.stats.num_faces,
            fetch_ms: picture.fetch_ms,
            render_ms: picture.render_ms,
            cpu_ms,
            samples: picture.stats.num_fragments,
            bytes_uploaded: picture.on_gpu.map_or(0, |gpu| gpu.bytes_uploaded),
            decode_ms: picture.on_gpu.map_or(0.0, |gpu| gpu.decode_ms),
            gpu_bytes_peak: picture.on_gpu.map_or(0, |gpu| gpu.gpu_bytes_peak),
            ..FrameTime::default()
        };
        let frame = CellFrame {
            time,
            misordered: picture.stats.num_misordered,
            faces_chosen: picture.num_chosen,
            lod: played.fraction,
        };
        Ok((frame, played.place))
    }
}

fn write_csv(path: &std::path::Path, frames: &[CellFrame]) -> std::io::Result<()> {
    let mut file = std::io::BufWriter::new(std::fs::File::create(path)?);
    writeln!(
        file,
        "frame,step,frame_ms,step_ms,render_ms,cpu_ms,wait_ms,fragments,misordered,faces_chosen,faces_drawn,lod,\
         hits,misses,dropped_steps,is_late,bytes_uploaded,decode_ms"
    )?;
    for (number, CellFrame { time: f, misordered, faces_chosen, lod }) in frames.iter().enumerate() {
        writeln!(
            file,
            "{number},{},{:.3},{:.3},{:.3},{:.3},{:.3},{},{misordered},{faces_chosen},{},{lod:.4},{},{},{},{},{},{:.3}",
            f.step,
            f.frame_ms,
            f.fetch_ms,
            f.render_ms,
            f.cpu_ms,
            f.wait_ms,
            f.samples,
            f.num_drawn,
            f.hits,
            f.misses,
            f.num_dropped,
            u8::from(f.is_late),
            f.bytes_uploaded,
            f.decode_ms
        )?;
    }
    file.flush()
}
