// Values at points as indices of the table, not rounded. No NaN and no infinity: shaders may assume that there is none.

// Where there is no value.
const MISSING: f32 = 3e38;
// Beyond every index of a value that is told from infinity.
const MOST_INDEX: f32 = 1e6;

fn is_missing(index: f32) -> bool {
    return index > 2e38;
}
