//! Figures of the paper: its tables 2 to 5.

/// Columns of tables 2 to 5 that the paper and this bench have in common.
pub const METRICS: [&str; 3] = ["scalar", "reference", "approximate"];
/// Rows of tables 4 and 5.
pub const TOLERANCES: [&str; 3] = ["zero", "slight", "moderate"];

/// A data set under a transfer function.
pub struct PaperCase {
    pub data: &'static str,
    pub transfer: &'static str,
    /// Table 2: seconds to compute each of [`METRICS`].
    pub build_secs: [f64; 3],
    /// Table 3: ms per frame without the tree, not cached and cached.
    pub plain_ms: [f64; 2],
    /// Tables 3 and 4: for each of [`TOLERANCES`] and [`METRICS`], ms per frame, not cached and cached.
    pub frame_ms: [[[f64; 2]; 3]; 3],
    /// Table 5: for each of [`TOLERANCES`] and [`METRICS`], % of voxels not rendered, as untextured polygons, from reused
    /// textures, from new ones.
    pub shares: [[[f64; 4]; 3]; 3],
}

const ALL_NEW: [f64; 4] = [0.0, 0.0, 0.0, 100.0];

/// All that the paper has.
pub const CASES: [PaperCase; 6] = [
    PaperCase {
        data: "small Delta, 111x126x51, 30 steps",
        transfer: "sparse",
        build_secs: [21.0, 248.0, 0.21],
        plain_ms: [111.0, 88.0],
        frame_ms: [
            [[379.0, 88.0], [221.0, 59.0], [218.0, 59.0]],
            [[214.0, 88.0], [185.0, 59.0], [189.0, 59.0]],
            [[181.0, 88.0], [156.0, 59.0], [153.0, 59.0]],
        ],
        shares: [
            [ALL_NEW, [29.0, 0.0, 0.0, 71.0], [29.0, 0.0, 0.0, 71.0]],
            [[0.0, 0.0, 40.0, 60.0], [29.0, 0.0, 13.0, 58.0], [29.0, 0.0, 12.0, 59.0]],
            [[0.0, 0.0, 60.0, 40.0], [29.0, 0.0, 32.0, 39.0], [29.0, 0.0, 32.0, 39.0]],
        ],
    },
    PaperCase {
        data: "small Delta, 111x126x51, 30 steps",
        transfer: "filled",
        build_secs: [21.0, 312.0, 0.21],
        plain_ms: [110.0, 87.0],
        frame_ms: [
            [[378.0, 88.0], [380.0, 88.0], [378.0, 88.0]],
            [[216.0, 88.0], [214.0, 88.0], [218.0, 87.0]],
            [[180.0, 87.0], [180.0, 88.0], [180.0, 88.0]],
        ],
        shares: [
            [ALL_NEW; 3],
            [[0.0, 0.0, 40.0, 60.0], [0.0, 0.0, 42.0, 58.0], [0.0, 0.0, 40.0, 60.0]],
            [[0.0, 0.0, 60.0, 40.0], [0.0, 0.0, 63.0, 37.0], [0.0, 0.0, 60.0, 40.0]],
        ],
    },
    PaperCase {
        data: "large Delta, 222x253x103, 12 steps",
        transfer: "sparse",
        build_secs: [170.0, 916.0, 0.33],
        plain_ms: [685.0, 726.0],
        frame_ms: [
            [[9060.0, 4580.0], [537.0, 65.0], [555.0, 65.0]],
            [[2508.0, 1985.0], [517.0, 63.0], [513.0, 64.0]],
            [[591.0, 142.0], [495.0, 64.0], [425.0, 64.0]],
        ],
        shares: [
            [ALL_NEW, [66.0, 0.0, 0.0, 34.0], [66.0, 0.0, 0.0, 34.0]],
            [[0.0, 0.0, 42.0, 58.0], [65.0, 0.0, 2.0, 33.0], [65.0, 0.0, 2.0, 32.0]],
            [[12.0, 0.0, 56.0, 32.0], [66.0, 0.0, 7.0, 27.0], [64.0, 0.0, 8.0, 26.0]],
        ],
    },
    PaperCase {
        data: "large Delta, 222x253x103, 12 steps",
        transfer: "filled",
        build_secs: [175.0, 1117.0, 0.33],
        plain_ms: [702.0, 726.0],
        frame_ms: [
            [[9080.0, 4596.0], [7585.0, 3974.0], [7594.0, 3976.0]],
            [[2630.0, 2079.0], [1105.0, 1502.0], [885.0, 1481.0]],
            [[570.0, 153.0], [525.0, 156.0], [602.0, 141.0]],
        ],
        shares: [
            [ALL_NEW, [0.0, 9.0, 0.0, 91.0], [0.0, 9.0, 0.0, 91.0]],
            [[0.0, 22.0, 18.0, 59.0], [0.0, 16.0, 42.0, 42.0], [0.0, 42.0, 16.0, 42.0]],
            [[0.0, 22.0, 47.0, 31.0], [0.0, 15.0, 59.0, 26.0], [0.0, 42.0, 25.0, 33.0]],
        ],
    },
    PaperCase {
        data: "F18, 402x135x103, 12 steps",
        transfer: "sparse",
        build_secs: [161.0, 887.0, 0.23],
        plain_ms: [657.0, 638.0],
        frame_ms: [
            [[8278.0, 3734.0], [447.0, 56.0], [496.0, 58.0]],
            [[2819.0, 2056.0], [367.0, 57.0], [384.0, 57.0]],
            [[666.0, 156.0], [273.0, 57.0], [280.0, 57.0]],
        ],
        shares: [
            [ALL_NEW, [61.0, 0.0, 4.0, 33.0], [62.0, 0.0, 0.0, 38.0]],
            [[0.0, 0.0, 40.0, 60.0], [61.0, 0.0, 11.0, 26.0], [62.0, 0.0, 10.0, 28.0]],
            [[3.0, 0.0, 60.0, 37.0], [60.0, 0.0, 20.0, 18.0], [62.0, 0.0, 20.0, 18.0]],
        ],
    },
    PaperCase {
        data: "shock, 512x64x64, 25 steps",
        transfer: "filled",
        build_secs: [160.0, 1481.0, 0.24],
        plain_ms: [296.0, 216.0],
        frame_ms: [
            [[1049.0, 1307.0], [461.0, 60.0], [470.0, 59.0]],
            [[458.0, 59.0], [265.0, 60.0], [241.0, 51.0]],
            [[356.0, 59.0], [198.0, 60.0], [184.0, 51.0]],
        ],
        shares: [
            [[0.0, 31.0, 0.0, 69.0], [0.0, 44.0, 1.0, 55.0], [0.0, 43.0, 0.0, 57.0]],
            [[0.0, 31.0, 17.0, 51.0], [0.0, 36.0, 37.0, 27.0], [0.0, 63.0, 11.0, 27.0]],
            [[0.0, 30.0, 30.0, 40.0], [0.0, 36.0, 46.0, 18.0], [0.0, 61.0, 21.0, 18.0]],
        ],
    },
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_add_up() {
        for case in &CASES {
            for shares in case.shares.iter().flatten() {
                // As printed, each rounded.
                assert!((shares.iter().sum::<f64>() - 100.0).abs() <= 2.0, "{}: {shares:?}", case.data);
            }
        }
    }
}
