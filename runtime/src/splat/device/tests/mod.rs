mod devices;
mod gradients;
mod pictures;
mod table;
