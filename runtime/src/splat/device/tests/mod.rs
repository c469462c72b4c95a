mod decoder;
mod devices;
mod fallback;
mod gradients;
mod pictures;
mod table;
mod training;
