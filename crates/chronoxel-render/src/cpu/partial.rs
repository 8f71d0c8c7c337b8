//! Partial images: what a run of boxes adds to a picture, kept to be composited again (shen1999, as told in
//! ellsworth2000, section 3).

use std::ops::Range;

use rayon::prelude::*;

use super::kernel::LEAST_TRANSMITTANCE;
use super::lanes::F8;

/// Columns and rows of pixels of a packet.
pub(super) const PACKET: [usize; 2] = [4, 2];

/// What the eight pixels of a packet have gathered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PacketPixels {
    /// Premultiplied red, green and blue.
    pub color: [F8; 3],
    /// One minus alpha.
    pub transmittance: F8,
}

impl PacketPixels {
    /// Pixels in which nothing is seen.
    pub const EMPTY: Self = Self { color: [F8([0.0; 8]); 3], transmittance: F8([1.0; 8]) };

    /// Puts pixels behind these; where a ray has ended, nothing is added.
    pub fn put_behind(&mut self, behind: &Self) {
        let mut weight = [0.0; 8];
        for (lane, weight) in weight.iter_mut().enumerate() {
            let transmittance = self.transmittance.0[lane];
            let is_alive = transmittance > LEAST_TRANSMITTANCE;
            *weight = if is_alive { transmittance } else { 0.0 };
            let factor = if is_alive { behind.transmittance.0[lane] } else { 1.0 };
            self.transmittance.0[lane] = transmittance * factor;
        }
        for (color, behind) in self.color.iter_mut().zip(&behind.color) {
            let lanes = color.0.iter_mut().zip(weight).zip(behind.0);
            lanes.for_each(|((color, weight), behind)| *color += weight * behind);
        }
    }
}

/// Colour (premultiplied) and transmittance that a run of boxes has in a picture, as if nothing were in front of them.
///
/// It holds for the view, the transfer function, the lighting and the step length that it was recorded with. Packets of 4
/// x 2 pixels in which nothing is seen are left out; the others take 16 bytes per pixel. Tiles do not matter: it may be
/// composited with others than it was recorded with.
#[derive(Debug, Clone, PartialEq)]
pub struct PartialImage {
    size: [usize; 2],
    pixels: [[usize; 2]; 2],
    /// For each row of packets from the first that has any, the index of its first packet; and the number of packets.
    row_starts: Box<[u32]>,
    /// Columns of packets, ascending in each row.
    columns: Box<[u16]>,
    packets: Box<[PacketPixels]>,
}

impl PartialImage {
    /// Width and height of the picture that it is a part of.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// Columns and rows of the picture between which all lies that it shows, half-open; empty where it shows nothing.
    pub fn pixels(&self) -> [[usize; 2]; 2] {
        self.pixels
    }

    /// Bytes held in memory.
    pub fn num_bytes(&self) -> usize {
        size_of::<Self>()
            + size_of_val(&*self.row_starts)
            + size_of_val(&*self.columns)
            + size_of_val(&*self.packets)
    }

    /// The packets in a part of a row of packets, each with its column.
    pub(super) fn packets_in(
        &self,
        row: usize,
        columns: Range<usize>,
    ) -> impl Iterator<Item = (usize, &PacketPixels)> {
        let first_row = self.pixels[1][0] / PACKET[1];
        let of_row = row.checked_sub(first_row).and_then(|row| self.row_starts.get(row..row + 2));
        let [from, to] = of_row.map_or([0, 0], |starts| [starts[0] as usize, starts[1] as usize]);
        let skipped = self.columns[from..to].partition_point(|&column| usize::from(column) < columns.start);
        let from = from + skipped;
        let in_row = self.columns[from..to].iter().zip(&self.packets[from..to]);
        in_row
            .map(|(&column, packet)| (usize::from(column), packet))
            .take_while(move |(column, _)| *column < columns.end)
    }

    /// An image from its packets.
    ///
    /// * `places`: row and column of each packet, ascending
    fn new(size: [usize; 2], places: &[[u16; 2]], packets: Box<[PacketPixels]>) -> Self {
        let Some(([first_row, _], [last_row, _])) = places.first().zip(places.last()) else {
            let nothing = [[0; 2]; 2];
            return Self { size, pixels: nothing, row_starts: [].into(), columns: [].into(), packets };
        };
        let columns: Box<[u16]> = places.iter().map(|[_, column]| *column).collect();
        let extent = columns.iter().fold([u16::MAX, 0], |e, &c| [e[0].min(c), e[1].max(c)]);
        let start_of = |row: u16| places.partition_point(|[r, _]| *r < row) as u32;
        let row_starts = (*first_row..=*last_row + 1).map(start_of).collect();
        let pixels = [extent, [*first_row, *last_row]];
        let in_pixels = |[first, last]: [u16; 2], a: usize| {
            [first, last + 1].map(|p| (usize::from(p) * PACKET[a]).min(size[a]))
        };
        let pixels = [in_pixels(pixels[0], 0), in_pixels(pixels[1], 1)];
        Self { size, pixels, row_starts, columns, packets }
    }
}

/// What a tile recorded.
#[derive(Debug, Default)]
pub(super) struct Recorded {
    /// Of each packet that shows something, its run and its row and column among the packets of the picture.
    places: Vec<(u32, [u16; 2])>,
    packets: Vec<PacketPixels>,
    /// Runs of which some ray came through to them.
    seen: Vec<u32>,
    /// Runs of which none did, and which were not drawn.
    hidden: Vec<u32>,
}

impl Recorded {
    /// Keeps what a run shows in a packet.
    pub fn push(&mut self, run: u32, [column, row]: [usize; 2], packet: PacketPixels) {
        // The sides of a picture have at most 32768 pixels.
        self.places.push((run, [row as u16, column as u16]));
        self.packets.push(packet);
    }

    /// Notes whether a run could be seen.
    pub fn push_run(&mut self, run: u32, is_seen: bool) {
        if is_seen { &mut self.seen } else { &mut self.hidden }.push(run);
    }
}

/// Takes, of runs that are seen in some tile, the others where they are hidden: they are drawn there after all.
///
/// * `recorded`: what each tile recorded
pub(super) fn take_hidden<'a, T: Copy>(
    num_runs: usize,
    recorded: impl Iterator<Item = (T, &'a mut Recorded)>,
) -> Vec<(T, u32)> {
    let recorded: Vec<_> = recorded.collect();
    let mut is_seen = vec![false; num_runs];
    for (_, tile) in &recorded {
        tile.seen.iter().for_each(|run| is_seen[*run as usize] = true);
    }
    let mut taken = Vec::new();
    for (tile, of_tile) in recorded {
        taken.extend(of_tile.hidden.extract_if(.., |run| is_seen[*run as usize]).map(|run| (tile, run)));
    }
    taken
}

/// Puts together what the tiles of a picture recorded: an image per run, and none where a tile did not draw the run.
pub(super) fn assemble(
    size: [usize; 2],
    num_runs: usize,
    recorded: &[Recorded],
) -> Vec<Option<PartialImage>> {
    let mut of_runs = vec![Some(Vec::new()); num_runs];
    for run in recorded.iter().flat_map(|tile| &tile.hidden) {
        of_runs[*run as usize] = None;
    }
    for tile in recorded {
        for ((run, place), packet) in tile.places.iter().zip(&tile.packets) {
            if let Some(of_run) = &mut of_runs[*run as usize] {
                of_run.push((*place, packet));
            }
        }
    }
    let image = |mut of_run: Vec<([u16; 2], &PacketPixels)>| {
        of_run.sort_by_key(|(place, _)| *place);
        let places: Vec<_> = of_run.iter().map(|(place, _)| *place).collect();
        PartialImage::new(size, &places, of_run.iter().map(|(_, packet)| **packet).collect())
    };
    of_runs.into_par_iter().map(|of_run| of_run.map(image)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(value: f32) -> PacketPixels {
        PacketPixels { color: [F8([value; 8]); 3], transmittance: F8([1.0 - value; 8]) }
    }

    #[test]
    fn tiles_join_to_an_image_whatever_their_order() {
        // Rows 3 and 5 of packets have some, row 4 has none.
        let places = [[3, 7], [3, 9], [5, 0], [5, 2], [5, 8]];
        let mut tiles = [Recorded::default(), Recorded::default(), Recorded::default()];
        for (i, [row, column]) in places.into_iter().enumerate() {
            tiles[[2, 0, 1, 1, 0][i]].push(1, [column, row], packet(i as f32 / 8.0));
        }
        tiles[1].push(2, [1, 1], packet(0.5));
        tiles[2].push_run(2, false);
        let images = assemble([39, 11], 3, &tiles);
        assert_eq!(images[0].as_ref().map(PartialImage::pixels), Some([[0, 0], [0, 0]]));
        assert_eq!(images[2], None);
        let image = images[1].as_ref().unwrap();
        // The last packets reach beyond the picture.
        assert_eq!(image.pixels(), [[0, 39], [6, 11]]);
        let found = |row, columns| -> Vec<_> {
            image.packets_in(row, columns).map(|(c, p)| (c, (p.color[0].0[0] * 8.0) as usize)).collect()
        };
        assert_eq!(found(3, 0..20), [(7, 0), (9, 1)]);
        assert_eq!(found(3, 8..9), []);
        assert_eq!(found(5, 1..8), [(2, 3)]);
        assert_eq!([found(2, 0..20), found(4, 0..20), found(6, 0..20)], [[], [], []]);
        // Five packets of eight pixels, their columns, and the starts of three rows.
        assert_eq!(image.num_bytes(), size_of::<PartialImage>() + 5 * 8 * 16 + 5 * 2 + 4 * 4);
    }

    #[test]
    fn pixels_behind_are_seen_as_far_as_those_in_front_let_through() {
        let mut pixels = packet(0.75);
        pixels.transmittance.0[3] = LEAST_TRANSMITTANCE;
        let before = pixels;
        pixels.put_behind(&packet(0.5));
        for lane in 0..8 {
            let expected = if lane == 3 { [0.75, LEAST_TRANSMITTANCE] } else { [0.875, 0.125] };
            assert_eq!([pixels.color[2].0[lane], pixels.transmittance.0[lane]], expected);
        }
        let mut same = before;
        same.put_behind(&PacketPixels::EMPTY);
        assert_eq!(same, before);
    }
}
