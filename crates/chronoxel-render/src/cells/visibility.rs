//! Faces in the order in which rays meet them.
//!
//! Of two tetrahedra with a common face, the one on the camera's side comes first (Williams 1992): that is known for sure, whatever their shapes,
//! where depths of centroids are wrong by as much as cells are long. So a tetrahedron gets the depth of its nearest corner, or that of one
//! before it, if that is larger; in the order of these depths, rays meet all tetrahedra that hang together one after the other. What lies behind
//! a gap comes by depth alone.

use chronoxel_core::{Camera, Projection};
use rayon::prelude::*;

use super::mesh::{NO_CELL, cross, dot, sub};
use super::{CellMesh, face_sort};

/// Of faces that are seen from their edges.
const NEITHER: u8 = 2;
/// Parts of the tetrahedra whose faces are listed on their own.
const NUM_PARTS: usize = 64;

/// What the order depends on: the direction of view, and in a perspective the eye.
pub(crate) fn depends_on(camera: &Camera) -> [[f64; 3]; 2] {
    let is_perspective = matches!(camera.projection(), Projection::Perspective { .. });
    [camera.axes()[2], if is_perspective { camera.position() } else { [0.0; 3] }]
}

/// Some faces of a mesh in order, nearest first.
///
/// * `faces`: their numbers, rising
pub(crate) fn order(mesh: &CellMesh, camera: &Camera, faces: &[u32]) -> Vec<u32> {
    let fronts = fronts(mesh, camera);
    let cells = order_of_cells(mesh, camera, &fronts);
    let is_chosen = (faces.len() < mesh.faces.len()).then(|| {
        let mut is_chosen = vec![false; mesh.faces.len()];
        faces.iter().for_each(|&face| is_chosen[face as usize] = true);
        is_chosen
    });
    let chosen = |face: &u32| is_chosen.as_ref().is_none_or(|chosen| chosen[*face as usize]);
    let of_part = |cells: &[u32]| {
        let mut of_part = Vec::with_capacity(3 * cells.len());
        for &cell in cells {
            let faces = mesh.faces_of_cells[cell as usize];
            let at = faces.map(|face| in_order(mesh.sides[face as usize], fronts[face as usize]));
            // A face comes after the tetrahedron in front of it, or where there is none before the one behind.
            let before = (0..4).filter(|&i| at[i] == [NO_CELL, cell]);
            let after = (0..4).filter(|&i| at[i][0] == cell);
            of_part.extend(before.chain(after).map(|i| faces[i]).filter(chosen));
        }
        of_part
    };
    let parts: Vec<Vec<u32>> =
        cells.par_chunks(cells.len().div_ceil(NUM_PARTS).max(1)).map(of_part).collect();
    parts.concat()
}

/// The tetrahedra at the sides of a face, that in front first.
fn in_order([above, below]: [u32; 2], front: u8) -> [u32; 2] {
    if front == 1 || (front == NEITHER && above == NO_CELL) { [below, above] } else { [above, below] }
}

/// For each face, which of its sides the camera is on: 0 where its normal points to the camera.
fn fronts(mesh: &CellMesh, camera: &Camera) -> Vec<u8> {
    let (eye, forward) = (camera.position(), camera.axes()[2]);
    let is_perspective = matches!(camera.projection(), Projection::Perspective { .. });
    let front = |face: &super::mesh::Face| {
        let [a, b, c] = face.points.map(|p| mesh.points[p as usize]);
        let to_camera = if is_perspective { sub(eye, a) } else { forward.map(|x| -x) };
        let along = dot(cross(sub(b, a), sub(c, a)), to_camera);
        if along > 0.0 {
            0
        } else if along < 0.0 {
            1
        } else {
            NEITHER
        }
    };
    mesh.faces.par_iter().with_min_len(1 << 12).map(front).collect()
}

fn order_of_cells(mesh: &CellMesh, camera: &Camera, fronts: &[u8]) -> Vec<u32> {
    let (forward, eye) = (camera.axes()[2], camera.position());
    let nearest = |cell: &[u32; 4]| {
        let depths = cell.map(|p| dot(sub(mesh.points[p as usize], eye), forward) as f32);
        depths[0].min(depths[1]).min(depths[2]).min(depths[3])
    };
    let mut keys: Vec<f32> = mesh.tetrahedra.par_iter().with_min_len(1 << 12).map(nearest).collect();
    // Tetrahedra right behind a face of another, and how many are before them that have not had their turn.
    let front_and_back = |face: u32| match fronts[face as usize] {
        NEITHER => [NO_CELL; 2],
        front => in_order(mesh.sides[face as usize], front),
    };
    let before = |(cell, faces): (usize, &[u32; 4])| {
        let is_before = |face: &&u32| {
            let [front, back] = front_and_back(**face);
            back == cell as u32 && front != NO_CELL
        };
        faces.iter().filter(is_before).count() as u8
    };
    let mut num_before: Vec<u8> =
        mesh.faces_of_cells.par_iter().enumerate().with_min_len(1 << 12).map(before).collect();
    let mut turns: Vec<u32> = Vec::with_capacity(keys.len());
    turns.extend((0..keys.len() as u32).filter(|&cell| num_before[cell as usize] == 0));
    let (mut next, mut passed) = (0, 0);
    while turns.len() < keys.len() || next < turns.len() {
        let Some(&cell) = turns.get(next) else {
            // Tetrahedra that lie before each other in a circle: one of them must begin.
            while num_before[passed] == 0 {
                passed += 1;
            }
            num_before[passed] = 0;
            turns.push(passed as u32);
            continue;
        };
        next += 1;
        let key = keys[cell as usize];
        for face in mesh.faces_of_cells[cell as usize] {
            let [front, back] = front_and_back(face);
            if front != cell || back == NO_CELL || num_before[back as usize] == 0 {
                continue;
            }
            let back = back as usize;
            keys[back] = keys[back].max(key);
            num_before[back] -= 1;
            if num_before[back] == 0 {
                turns.push(back as u32);
            }
        }
    }
    // Equal depths keep the order of their turns.
    let in_turn: Vec<f32> = turns.par_iter().with_min_len(1 << 14).map(|&cell| keys[cell as usize]).collect();
    let order = face_sort::order_of(&in_turn);
    order.into_par_iter().with_min_len(1 << 14).map(|i| turns[i as usize]).collect()
}
