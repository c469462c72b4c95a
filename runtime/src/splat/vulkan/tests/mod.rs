//! The executor on whatever Vulkan device is here.

mod copies;
mod pages;
mod steady_state;
