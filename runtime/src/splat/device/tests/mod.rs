mod decoder;
mod devices;
mod fallback;
mod gradients;
mod kernels;
mod pictures;
mod table;
mod training;
