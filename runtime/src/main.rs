//! `kilogs`: the command line.

#[global_allocator]
static ALLOCATOR: kilogs::seal::CountingAllocator = kilogs::seal::CountingAllocator;

fn main() {}
