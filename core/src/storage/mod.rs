//! Bounded containers on memory that the caller hands in.
