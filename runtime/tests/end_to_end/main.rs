//! The program as people run it: the binary, its files, its messages and its exit codes.
//!
//! Everything is driven through the simulated street, so that nothing has to be there but the binary. Nothing waits
//! without a deadline: a run that hangs fails its test.

mod drive;
mod program;

mod device;
mod fit;
mod refusals;
mod replay;

mod interruption;
mod live;
mod loops;
