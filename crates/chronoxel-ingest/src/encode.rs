//! The encoder: one pass over the steps of a series, each sample read once, into a store.

mod analyse;
mod coding;
mod cut;
mod mark;
mod pad;
mod pyramid;
mod real;
mod stream;
mod window;
