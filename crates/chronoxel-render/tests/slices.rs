//! The incremental slicer against plane–box intersections by brute force, and what holds between boxes.

mod slices_by_force;

use chronoxel_core::{Camera, Projection, UniformGrid};
use chronoxel_render::{SliceList, SliceOrder, Slicer};
use slices_by_force::{Case, Random, area_of, edges_between, force, scale_of, slice, tolerance};

const ORDERS: [SliceOrder; 2] = [SliceOrder::BackToFront, SliceOrder::FrontToBack];

/// The polygons of a case, nearest slice first.
fn polygons_of(case: &Case, order: SliceOrder) -> Vec<(i32, Vec<[f64; 3]>)> {
    let list = slice(case, &[case.bounds], order);
    let polygons = (0..list.num_polygons()).map(|i| {
        assert!((3..=6).contains(&list.polygon(i).len()), "{case:?}");
        (list.slices()[i], list.polygon(i).iter().map(|p| p.map(f64::from)).collect())
    });
    let mut polygons: Vec<_> = polygons.collect();
    if order == SliceOrder::BackToFront {
        polygons.reverse();
    }
    polygons
}

/// Whether two polygons have the same vertices, to a tolerance, in the same order from whichever one on.
fn is_same(found: &[[f64; 3]], expected: &[[f64; 3]], tolerance: f64) -> bool {
    let close = |a: &[f64; 3], b: &[f64; 3]| (0..3).all(|i| (a[i] - b[i]).abs() <= tolerance);
    let n = found.len();
    n == expected.len() && (0..n).any(|turn| (0..n).all(|i| close(&found[i], &expected[(i + turn) % n])))
}

fn assert_as_by_force(case: &Case, order: SliceOrder) -> usize {
    let (found, expected) = (polygons_of(case, order), force(case));
    let slices = |polygons: &[(i32, Vec<[f64; 3]>)]| polygons.iter().map(|p| p.0).collect::<Vec<_>>();
    assert_eq!(slices(&found), slices(&expected), "{case:?}");
    let tolerance = tolerance(case);
    for ((slice, found), (_, expected)) in found.iter().zip(&expected) {
        assert!(is_same(found, expected, tolerance), "{case:?}, slice {slice}: {found:?}, not {expected:?}");
        // The area is signed: positive where the polygon runs counter-clockwise as seen from the eye.
        let (area, right) = (area_of(found, case.normal), area_of(expected, case.normal));
        let bound = 12.0 * tolerance * (scale_of(case.bounds) + tolerance);
        assert!((area - right).abs() <= bound, "{case:?}, slice {slice}: area {area}, not {right}");
        assert!(found.iter().flatten().enumerate().all(|(i, &c)| {
            let [low, high] = [case.bounds[0][i % 3] as f32, case.bounds[1][i % 3] as f32].map(f64::from);
            (low..=high).contains(&c)
        }));
    }
    found.len()
}

#[test]
fn polygons_are_those_found_by_force() {
    let mut random = Random(1);
    let (mut num_cases, mut num_polygons, mut num_vertices) = (0, 0, [0; 7]);
    for i in 0..30_000 {
        let case = Case::any(&mut random);
        num_polygons += assert_as_by_force(&case, ORDERS[i % 2]);
        force(&case).iter().for_each(|(_, polygon)| num_vertices[polygon.len()] += 1);
        num_cases += 1;
    }
    println!("{num_cases} boxes, {num_polygons} polygons, with 3 to 6 vertices: {:?}", &num_vertices[3..]);
    assert!(num_polygons > 200_000 && num_vertices[3..].iter().all(|&n| n > 5_000), "{num_vertices:?}");
}

#[test]
fn planes_through_corners_edges_and_faces_are_owned_by_rule() {
    let mut random = Random(2);
    let mut num_ties = 0;
    for i in 0..10_000 {
        let case = Case::with_ties(&mut random);
        assert_as_by_force(&case, ORDERS[i % 2]);
        num_ties += case.num_ties();
    }
    assert!(num_ties > 10_000, "{num_ties}");
    // A view along z, planes a unit apart: the box owns the plane in its nearer face and not that in its farther one.
    for (normal, expected) in [([0.0, 0.0, 1.0], [2, 3, 4]), ([0.0, 0.0, -1.0], [-5, -4, -3])] {
        let bounds = [[0.0, 0.0, 2.0], [1.0, 1.0, 5.0]];
        let list = slice(&Case { normal, bounds, ..Case::unit() }, &[bounds], SliceOrder::FrontToBack);
        assert_eq!(list.slices(), expected);
        assert!(list.firsts() == [0, 4, 8] && list.positions().len() == 12);
    }
}

/// The eight parts of a box about a point in it.
fn octants(bounds: [[f64; 3]; 2], middle: [f64; 3]) -> Vec<[[f64; 3]; 2]> {
    let part = |i: usize| {
        let low = std::array::from_fn(|a| if i >> a & 1 == 0 { bounds[0][a] } else { middle[a] });
        let high = std::array::from_fn(|a| if i >> a & 1 == 0 { middle[a] } else { bounds[1][a] });
        [low, high]
    };
    (0..8).map(part).collect()
}

#[test]
fn a_box_in_eight_has_the_slices_of_the_whole() {
    let mut random = Random(3);
    for i in 0..8_000 {
        let case = if i % 2 == 0 { Case::any(&mut random) } else { Case::with_ties(&mut random) };
        let t = random.between(0.2, 0.8);
        let t = if i % 2 == 0 { t } else { 0.5 };
        let middle = std::array::from_fn(|a| case.bounds[0][a] + t * (case.bounds[1][a] - case.bounds[0][a]));
        let list = slice(&case, &octants(case.bounds, middle), ORDERS[i / 2 % 2]);
        let tolerance = tolerance(&case);
        let uncut = slice(&case, &[case.bounds], ORDERS[i % 2]);
        // Boxes of different sizes agree about the vertices on lines that they share.
        let has_vertex = |v: &[f32; 3]| list.positions().contains(v);
        assert!(uncut.positions().iter().all(has_vertex), "{case:?}");
        for (index, whole) in force(&case) {
            let polygons = (0..list.num_polygons()).filter(|&p| list.slices()[p] == index);
            let parts: Vec<&[[f32; 3]]> = polygons.map(|p| list.polygon(p)).collect();
            let area: f64 = parts
                .iter()
                .map(|p| area_of(&p.iter().map(|v| v.map(f64::from)).collect::<Vec<_>>(), case.normal))
                .sum();
            let bound = 60.0 * tolerance * (scale_of(case.bounds) + tolerance);
            let right = area_of(&whole, case.normal);
            assert!((area - right).abs() <= bound, "{case:?}, slice {index}: {area}, not {right}");
            // Where two parts meet, their polygons have an edge in common, to the bit.
            let open = edges_between(&parts, case.bounds);
            assert!(open.is_empty(), "{case:?}, slice {index}: cracks at {open:?}");
        }
        let of_whole: Vec<i32> = force(&case).iter().map(|(index, _)| *index).collect();
        assert!(list.slices().iter().all(|index| of_whole.contains(index)), "{case:?}");
    }
}

#[test]
fn a_million_slices_do_not_drift() {
    let bounds = [[0.0, 0.0, 0.0], [1.0, 2.0, 700.0]];
    let normal = [0.6, 0.0, 0.8];
    let case = Case { normal, bounds, distance: 560.6 / 1_048_500.0, ..Case::unit() };
    for order in ORDERS {
        let list = slice(&case, &[bounds], order);
        assert!(list.num_polygons() > 1_048_000);
        for i in 0..list.num_polygons() {
            for p in list.polygon(i).iter().map(|p| p.map(f64::from)) {
                let off = (0.6 * p[0] + 0.8 * p[2] - f64::from(list.slices()[i]) * case.distance).abs();
                // Half a unit in the last place of a single-precision number below 1024, and nothing else.
                assert!(off <= 0.8 * 0.5f64.powi(15) + 0.6 * 0.5f64.powi(25) + 1e-11, "slice {i}: {off}");
            }
        }
    }
}

#[test]
fn both_orders_give_the_same_polygons() {
    let mut random = Random(5);
    for _ in 0..2_000 {
        let case = Case::any(&mut random);
        let [back, front] = ORDERS.map(|order| polygons_of(&case, order));
        assert_eq!(back.len(), front.len());
        for ((i, a), (j, b)) in back.iter().zip(&front) {
            assert!(i == j && is_same(a, b, 0.0), "{case:?}");
        }
    }
}

#[test]
fn a_camera_sees_planes_in_front_of_it_in_world_and_voxel_coordinates() {
    let grid = UniformGrid::new([21, 31, 41], [3.0, -4.0, 10.0], [0.5, 0.25, 2.0]).unwrap();
    let eye = grid.world_from_voxel([10.3, 14.9, 20.2]);
    for projection in [Projection::Perspective { fov_y_deg: 60.0 }, Projection::Orthographic { height: 5.0 }]
    {
        let camera = Camera::new(eye, grid.bounds()[1], [0.0, 1.0, 0.0], projection).unwrap();
        let order = SliceOrder::FrontToBack;
        let (mut world, mut voxels) = (SliceList::default(), SliceList::default());
        Slicer::of_camera(&camera, 0.3, SliceOrder::BackToFront)
            .unwrap()
            .slice(grid.bounds(), &mut world)
            .unwrap();
        let mut from_the_back = world.slices().to_vec();
        from_the_back.reverse();
        world.clear();
        Slicer::of_camera(&camera, 0.3, order).unwrap().slice(grid.bounds(), &mut world).unwrap();
        let region = [[0.0; 3], grid.dims.map(|n| (n - 1) as f64)];
        let slicer = Slicer::of_camera_in_voxels(&camera, &grid, 0.3, order).unwrap();
        assert_eq!(slicer.slice(region, &mut voxels).unwrap(), voxels.num_polygons());
        assert!(world.slices() == voxels.slices() && world.firsts() == voxels.firsts());
        assert_eq!(world.slices(), from_the_back);
        assert_eq!(world.slices(), (1..=world.num_polygons() as i32).collect::<Vec<_>>());
        for (world, voxel) in world.positions().iter().zip(voxels.positions()) {
            let mapped = grid.world_from_voxel(voxel.map(f64::from));
            assert!((0..3).all(|a| (mapped[a] - f64::from(world[a])).abs() < 1e-5), "{mapped:?} {world:?}");
        }
        let depth = |p: &[f32; 3]| camera.project(p.map(f64::from), [1, 1]).unwrap()[2];
        let last = world.num_polygons() - 1;
        for i in [0, 1, last] {
            let right = 0.3 * f64::from(world.slices()[i]);
            assert!(world.polygon(i).iter().all(|p| (depth(p) - right).abs() < 1e-5));
        }
    }
}

#[test]
fn a_view_that_is_along_an_axis_but_for_rounding_has_whole_faces() {
    let bounds = [[0.0; 3], [8.0; 3]];
    for (azimuth, elevation) in [(90.0, 0.0), (180.0, 0.0), (270.0, 0.0), (0.0, 90.0), (37.0, -90.0)] {
        let camera = Camera::orbit(bounds, azimuth, elevation, 1.0, Some(30.0), 1.0).unwrap();
        let mut list = SliceList::default();
        Slicer::of_camera(&camera, 0.25, SliceOrder::BackToFront).unwrap().slice(bounds, &mut list).unwrap();
        assert!(
            (32..=33).contains(&list.num_polygons()) && list.positions().len() == 4 * list.num_polygons()
        );
        for i in 0..list.num_polygons() {
            let at_corners = list.polygon(i).iter().flatten().filter(|&&c| c == 0.0 || c == 8.0).count();
            assert!(at_corners >= 8, "{azimuth} {elevation}: {:?}", list.polygon(i));
        }
    }
}

#[test]
fn rounding_of_a_direction_along_an_axis_moves_no_plane_out_of_a_face() {
    let bounds = [[0.0; 3], [1024.0, 1024.0, 8.0]];
    for order in ORDERS {
        let (normal, origin) = ([6.1e-17, -1.2e-16, 1.0], [512.0, 512.0, -10.0]);
        let list = slice(&Case { normal, origin, distance: 0.25, bounds }, &[bounds], order);
        assert_eq!((list.num_polygons(), list.positions().len()), (32, 128));
        assert_eq!(list.slices().iter().min(), Some(&40));
        let is_corner = |p: &[f32; 3]| [0, 1].iter().all(|&a| p[a] == 0.0 || p[a] == 1024.0);
        assert!(list.positions().iter().all(is_corner));
    }
}

#[test]
fn vertices_stay_in_the_box_where_rounding_moves_them_along_edges() {
    let mut random = Random(6);
    let mut num_vertices = 0;
    for _ in 0..2_000 {
        let tilts = [(); 2].map(|()| 10f64.powf(random.between(-11.5, -9.0)));
        let low = [(); 3].map(|()| random.between(10.0, 20.0));
        let bounds = [low, low.map(|c| c + 1.0)];
        // The plane 1 is the one in which, but for rounding, the near face lies.
        let (origin, normal) = ([-500.0, 300.0, -1000.0], [tilts[0], -tilts[1], 1.0]);
        let middle: f64 = (0..2).map(|a| normal[a] * (low[a] + 0.5 - origin[a])).sum();
        let case = Case { normal, origin, distance: low[2] - origin[2] + middle, bounds };
        let list = slice(&case, &[bounds], SliceOrder::FrontToBack);
        num_vertices += list.positions().len();
        for p in list.positions() {
            let is_inside = |a: usize| (bounds[0][a] as f32..=bounds[1][a] as f32).contains(&p[a]);
            assert!((0..3).all(is_inside), "{case:?}: {p:?}");
        }
    }
    assert!(num_vertices > 6_000, "{num_vertices}");
}

#[test]
fn triangles_are_fans_of_the_polygons() {
    let case = Case { normal: [1.0, 1.1, 1.2], distance: 0.2, ..Case::unit() };
    let list = slice(&case, &[case.bounds], SliceOrder::BackToFront);
    let mut triangles = Vec::new();
    list.push_triangles(0, &mut triangles);
    let num_triangles: usize = (0..list.num_polygons()).map(|i| list.polygon(i).len() - 2).sum();
    assert_eq!(triangles.len(), num_triangles);
    let place = |v: u32| list.positions()[v as usize].map(f64::from);
    let area: f64 = triangles.iter().map(|t| area_of(&t.map(place), case.normal)).sum();
    let right: f64 = force(&case).iter().map(|(_, polygon)| area_of(polygon, case.normal)).sum();
    assert!((area - right).abs() < 1e-5 && right > 1.0, "{area}, not {right}");
    let mut tail = Vec::new();
    list.push_triangles(list.num_polygons() - 1, &mut tail);
    assert_eq!(tail, triangles[triangles.len() - (list.polygon(list.num_polygons() - 1).len() - 2)..]);
}

#[test]
fn lists_are_cleared_and_empty_boxes_leave_them_as_they_are() {
    let case = Case { normal: [1.0, 2.0, 3.0], distance: 0.5, ..Case::unit() };
    let mut list = slice(&case, &[case.bounds], SliceOrder::BackToFront);
    let before = list.clone();
    let slicer = Slicer::new(case.normal, [0.0; 3], 0.5, SliceOrder::BackToFront).unwrap();
    assert_eq!(slicer.slice([[0.0; 3], [1.0, 0.0, 1.0]], &mut list), Ok(0));
    assert_eq!(slicer.slice([[2.0; 3], [1.0; 3]], &mut list), Ok(0));
    assert_eq!(list, before);
    list.clear();
    assert_eq!(list, SliceList::default());
}

#[test]
fn what_cannot_be_sliced_is_refused() {
    let order = SliceOrder::BackToFront;
    for (normal, origin, distance, word) in [
        ([0.0; 3], [0.0; 3], 1.0, "normal"),
        ([f64::NAN, 1.0, 0.0], [0.0; 3], 1.0, "normal"),
        ([f64::INFINITY, 1.0, 0.0], [0.0; 3], 1.0, "normal"),
        ([1.0, 0.0, 0.0], [f64::NAN; 3], 1.0, "origin"),
        ([1.0, 0.0, 0.0], [0.0; 3], 0.0, "distance"),
        ([1.0, 0.0, 0.0], [0.0; 3], -1.0, "distance"),
        ([1.0, 0.0, 0.0], [0.0; 3], f64::NAN, "distance"),
    ] {
        let message = Slicer::new(normal, origin, distance, order).unwrap_err().to_string();
        assert!(message.contains(word) && !message.contains('\n'), "{message}");
    }
    let slicer = Slicer::new([0.0, 0.0, 1.0], [0.0; 3], 1.0, order).unwrap();
    let mut list = SliceList::default();
    for (low, high, word) in [
        (0.0, f64::NAN, "box"),
        (f64::NEG_INFINITY, 0.0, "box"),
        (0.0, 1_048_577.0, "slices of a box"),
        (2e9, 2e9 + 1.0, "slices up to a box"),
        (0.0, 1e29, "slices up to a box"),
    ] {
        let message = slicer.slice([[0.0, 0.0, low], [1.0, 1.0, high]], &mut list).unwrap_err().to_string();
        assert!(message.contains(word) && !message.contains('\n'), "{message}");
        assert_eq!(list, SliceList::default());
    }
    assert_eq!(slicer.slice([[0.0; 3], [1.0, 1.0, 1_048_576.0]], &mut list), Ok(1_048_576));
}
