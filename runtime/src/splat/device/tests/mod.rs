mod devices;
mod pictures;
mod table;
