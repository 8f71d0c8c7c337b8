//! The order of file names in which `step9` comes before `step10`.

use std::cmp::Ordering;

/// Compares names, runs of digits by their value; names of equal value by their bytes.
pub(crate) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut rest_a, mut rest_b) = (a, b);
    while let (Some(first_a), Some(first_b)) = (rest_a.chars().next(), rest_b.chars().next()) {
        let order = if first_a.is_ascii_digit() && first_b.is_ascii_digit() {
            let (number_a, number_b) = (split_digits(&mut rest_a), split_digits(&mut rest_b));
            number_a.len().cmp(&number_b.len()).then_with(|| number_a.cmp(number_b))
        } else {
            rest_a = &rest_a[first_a.len_utf8()..];
            rest_b = &rest_b[first_b.len_utf8()..];
            first_a.cmp(&first_b)
        };
        if order.is_ne() {
            return order;
        }
    }
    rest_a.len().cmp(&rest_b.len()).then_with(|| a.cmp(b))
}

/// Takes the digits off the front, without their leading zeros.
fn split_digits<'a>(text: &mut &'a str) -> &'a str {
    let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (digits, rest) = text.split_at(end);
    *text = rest;
    digits.trim_start_matches('0')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_are_compared_by_value() {
        let mut names =
            ["b1", "a10.vti", "a9.vti", "a009b", "a1_2", "a1_10", "a", "a18446744073709551617", "a2"];
        names.sort_by(|a, b| natural_order(a, b));
        let expected =
            ["a", "a1_2", "a1_10", "a2", "a9.vti", "a009b", "a10.vti", "a18446744073709551617", "b1"];
        assert_eq!(names, expected);
        assert_eq!(natural_order("a01", "a1"), Ordering::Less);
        assert_eq!(natural_order("a1", "a1"), Ordering::Equal);
    }
}
