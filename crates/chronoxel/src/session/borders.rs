//! Pictures that are filtered across the borders of levels.

use std::time::Instant;

use chronoxel_core::SpanKind;
use chronoxel_render::{DrawBrick, LevelBorders, filter_level_borders};
use chronoxel_stream::{DrawItem, How};

use super::{BrickCounts, Drawing, Session};

impl Session {
    /// Draws a draw list in portions that fit the memory; with each comes what its bricks take values from.
    pub(super) fn draw_filtered(
        &mut self,
        items: &[DrawItem],
        step: u32,
        weight: f64,
        drawing: &mut Drawing<'_>,
    ) -> anyhow::Result<()> {
        let places: Vec<_> = items.iter().map(|item| (item.node, item.region)).collect();
        let borders = LevelBorders::new(&places, &self.store.header().bricks);
        let mut first = 0;
        while first < items.len() {
            let start = Instant::now();
            // Each as it is, and as it is drawn.
            let num_payloads = items[first..].iter().map(|item| 2 * usize::from(item.how == How::Payload));
            let portion = first..first + self.num_in_portion(num_payloads);
            let others = borders.needed_by(portion.clone()).into_iter().map(|i| items[i].clone());
            let others: Vec<DrawItem> = others.collect();
            let mut draws = match weight > 0.0 {
                false => self.fetch(&items[portion.clone()], &mut drawing.bricks, &mut drawing.faults)?,
                true => self.fetch_between(&items[portion.clone()], step, weight, &mut drawing.bricks)?,
            };
            // Counted, and warned about, with the portion in which they are drawn.
            let mut uncounted = BrickCounts::default();
            draws.extend(match weight > 0.0 {
                false => self.fetch(&others, &mut uncounted, &mut super::Faults::default())?,
                true => self.fetch_between(&others, step, weight, &mut uncounted)?,
            });
            let filtered = self.filtered(&draws, step)?;
            drawing.fetch_ms += start.elapsed().as_secs_f64() * 1e3;
            drawing.frame.draw(&filtered[..portion.len()])?;
            first = portion.end;
        }
        Ok(())
    }

    /// Bricks that meet coarser ones of the list without a jump.
    fn filtered(&mut self, draws: &[DrawBrick], step: u32) -> anyhow::Result<Vec<DrawBrick>> {
        let places: Vec<_> = draws.iter().map(|draw| (draw.node, draw.region)).collect();
        let borders = LevelBorders::new(&places, &self.store.header().bricks);
        let mut ranges = vec![None; draws.len()];
        for i in (0..draws.len()).filter(|&i| draws[i].is_sampled()) {
            for &other in borders.coarser_than(i) {
                if ranges[other].is_none() && !draws[other].is_sampled() {
                    let tree = std::sync::Arc::clone(&self.tree);
                    let record = self.record(&tree, draws[other].node, step)?;
                    ranges[other] = (record.kind != SpanKind::Empty).then_some(record.drawn_range);
                }
            }
        }
        Ok(filter_level_borders(draws, &borders, &|i| ranges[i]))
    }
}
