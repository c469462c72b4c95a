//! Trajectory and image quality figures.
