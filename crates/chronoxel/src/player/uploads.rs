//! A limit of what is sent to the GPU in a frame.

use std::{collections::HashSet, sync::Arc};

use chronoxel_core::{NodeId, SpanKind};
use chronoxel_stream::{DrawItem, How};

use super::Player;
use crate::session::Session;

impl Player {
    /// Has coarser bricks stand in for those whose payloads do not go to the GPU in this frame, and sends what the next steps need as far as the limit goes.
    ///
    /// Lists and colours are sent in any case: what they took in the frame before is set aside for them.
    pub(super) fn limit_uploads(
        &mut self,
        items: &mut [DrawItem],
        place: usize,
        limit: u64,
    ) -> anyhow::Result<usize> {
        let tree = Arc::clone(self.session.tree());
        let mut left = limit.saturating_sub(self.upload_overhead);
        let step = self.step_at(place);
        let (mut num_stand_ins, mut sent) = (0, HashSet::new());
        self.payload_upload = 0;
        // What stands in for others comes first.
        let mut order: Vec<usize> = (0..items.len()).filter(|&i| items[i].how == How::Payload).collect();
        order.sort_by_key(|&i| std::cmp::Reverse(items[i].node.level));
        let root_bytes = self.session.upload_bytes(tree.root(), step);
        // The root must be there: without it nothing could stand in. It is one payload.
        let mut take =
            |session: &mut Session, node: NodeId, at: u32, must: bool, left: &mut u64, total: &mut u64| {
                let bytes = session.upload_bytes(node, at);
                if bytes == 0 || sent.contains(&node) {
                    return true;
                }
                let fits = bytes <= *left || must;
                if fits {
                    sent.insert(node);
                    *left = left.saturating_sub(bytes);
                    *total += bytes;
                }
                fits
            };
        let mut total = 0;
        if root_bytes > 0 {
            take(&mut self.session, tree.root(), step, true, &mut left, &mut total);
        }
        for i in order {
            let mut node = items[i].node;
            if take(&mut self.session, node, items[i].steps.start, false, &mut left, &mut total) {
                continue;
            }
            while node != tree.root() {
                node = node.parent();
                let Ok(record) = self.session.record(&tree, node, step) else { continue };
                let how = match (record.kind, record.mask) {
                    (SpanKind::Empty, _) => How::Skip,
                    (SpanKind::Constant(value), None) => How::Constant(value),
                    _ => How::Payload,
                };
                let is_root = node == tree.root();
                let is_there = self.can_draw(&tree, node, step)
                    && take(&mut self.session, node, step, is_root, &mut left, &mut total);
                if how != How::Payload || is_there {
                    items[i] = DrawItem { node, region: items[i].region, steps: step..step + 1, how };
                    num_stand_ins += 1;
                    break;
                }
            }
        }
        self.payload_upload = total + self.upload_ahead(place, left)?;
        Ok(num_stand_ins)
    }

    /// Sends payloads of the next steps, nearest first.
    fn upload_ahead(&mut self, place: usize, mut left: u64) -> anyhow::Result<u64> {
        let mut total = 0;
        let nodes: Vec<NodeId> = self.cut.nodes().collect();
        for place in self.coming(place) {
            let step = self.step_at(place);
            if self.spans_in_memory(step).is_none() {
                break;
            }
            for node in &nodes {
                let bytes = self.session.upload_bytes(*node, step);
                if bytes == 0 {
                    continue;
                }
                if bytes > left {
                    return Ok(total);
                }
                match self.session.upload_ahead(*node, step)? {
                    Some(sent) => (left, total) = (left.saturating_sub(sent), total + sent),
                    None => return Ok(total),
                }
            }
        }
        Ok(total)
    }
}
