//! Copies to, from and within the device's buffers, the cap of the arena, and a loss.

use crate::splat::Capacities;
use crate::splat::device::{DeviceError, EXCHANGE_BYTES, Executor, arena_bytes};
use crate::splat::program::{Buffer, buffer_plan};
use crate::splat::vulkan::VulkanExecutor;
use crate::splat::vulkan::testing::device;

pub(super) fn capacities() -> Capacities {
    Capacities { learned_decoder: true, ..Capacities::for_map(65_536, 2, 64, 48) }
}

pub(super) fn executor() -> Option<VulkanExecutor> {
    Some(VulkanExecutor::new(&device()?, &capacities(), arena_bytes(&capacities())).expect("an executor"))
}

fn pattern(n: usize, seed: usize) -> Vec<u8> {
    (0..n).map(|i| (i * 7 + i / 251 + seed) as u8).collect()
}

#[test]
fn what_goes_up_comes_down_at_every_size() {
    let Some(mut executor) = executor() else { return };
    let total = buffer_plan(&capacities())[Buffer::Params as usize].bytes();
    assert!(total > EXCHANGE_BYTES, "the largest case goes in pieces");
    for (offset, len) in [(0, 4), (4, 16), (20, 1000), (0, EXCHANGE_BYTES), (4, EXCHANGE_BYTES + 4), (0, total)] {
        let sent = pattern(len, offset);
        let mut read = vec![0; len];
        executor.upload(Buffer::Params, offset, &sent).expect("an upload");
        executor.download(Buffer::Params, offset, &mut read).expect("a download");
        assert!(read == sent, "{len} bytes at {offset}");
    }
}

#[test]
fn calls_take_effect_in_the_order_in_which_they_are_made() {
    let Some(mut executor) = executor() else { return };
    let mut read = [9; 16];
    executor.download(Buffer::Params, 0, &mut read).expect("a download");
    assert_eq!(read, [0; 16], "buffers are zero at first");
    executor.upload(Buffer::Params, 0, &[1; 16]).expect("an upload");
    executor.upload(Buffer::Params, 4, &[2; 8]).expect("an upload");
    executor.clear(Buffer::Params, 8, 4).expect("a clear");
    executor.upload(Buffer::Anchors, 0, &[3; 16]).expect("an upload");
    executor.download(Buffer::Params, 0, &mut read).expect("a download");
    assert_eq!(read, [1, 1, 1, 1, 2, 2, 2, 2, 0, 0, 0, 0, 1, 1, 1, 1]);
    executor.download(Buffer::Anchors, 0, &mut read).expect("a download");
    assert_eq!(read, [3; 16]);
}

#[test]
fn two_executors_do_not_share_memory() {
    let (Some(mut one), Some(mut other)) = (executor(), executor()) else { return };
    let mut read = [9; 4];
    one.upload(Buffer::Params, 0, &[1; 4]).expect("an upload");
    other.download(Buffer::Params, 0, &mut read).expect("a download");
    assert_eq!(read, [0; 4]);
}

#[test]
fn a_cap_one_byte_short_is_refused_by_name() {
    let Some(device) = device() else { return };
    let exact = VulkanExecutor::new(&device, &capacities(), arena_bytes(&capacities()))
        .expect("an executor")
        .device_bytes() as u64;
    assert!(VulkanExecutor::new(&device, &capacities(), exact).is_ok(), "to the last byte");
    let refused = |cap| match VulkanExecutor::new(&device, &capacities(), cap) {
        Err(DeviceError::ArenaFull(full)) => full.row,
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("{cap} bytes were enough"),
    };
    assert_eq!(refused(exact - 1), "splat.device.exchange");
    let first = buffer_plan(&capacities())[0];
    assert_eq!(refused(first.bytes() as u64 - 1), first.name);
}

#[test]
fn a_buffer_beyond_the_limit_of_the_device_is_refused_by_name() {
    let Some(device) = device() else { return };
    let limit = device.info().max_storage_bytes;
    let anchors = usize::try_from(limit / 64).expect("64 bits");
    match VulkanExecutor::new(&device, &Capacities::for_map(anchors, 2, 64, 48), u64::MAX) {
        Err(DeviceError::BufferTooLarge { name, .. }) => assert_eq!(name, "splat.device.params"),
        Err(DeviceError::TooLittleMemory { .. }) if limit > 1 << 30 => {}
        other => panic!("{:?}", other.err()),
    }
}

#[test]
fn more_workgroups_than_the_device_takes_are_refused_by_name() {
    let Some(device) = device() else { return };
    let slots = 256 * (device.limits().max_groups[0] as usize + 1);
    match VulkanExecutor::new(&device, &Capacities::for_map(slots, 1, 64, 48), u64::MAX) {
        Err(DeviceError::TooManyGroups { name, .. }) => assert_eq!(name, "splat.device.anchors"),
        other => panic!("{:?}", other.err()),
    }
}

#[test]
fn a_lost_device_is_told_and_nothing_hangs() {
    let Some(mut executor) = executor() else { return };
    let mut read = [0; 4];
    executor.lose_after(1);
    executor.download(Buffer::Params, 0, &mut read).expect("before the loss");
    for _ in 0..2 {
        let lost = executor.download(Buffer::Params, 0, &mut read);
        assert!(matches!(lost, Err(DeviceError::Lost { .. })), "{lost:?}");
    }
}
