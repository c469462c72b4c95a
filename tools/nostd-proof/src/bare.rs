//! What the C start files and libc do for other programs: entry, exit, memory functions, panic.
//!
//! The only unsafe code of the proof; `kilogs-core` itself forbids it.

use crate::{drive, problems};
use core::arch::{asm, global_asm};
use core::panic::PanicInfo;

#[cfg(not(all(target_os = "linux", any(target_arch = "x86_64", target_arch = "aarch64"))))]
compile_error!("the proof knows how to start and exit on Linux on x86-64 and aarch64 only");

#[cfg(target_arch = "x86_64")]
global_asm!(".globl _start", "_start:", "xor ebp, ebp", "and rsp, -16", "call {main}", "ud2", main = sym bare_main);
#[cfg(target_arch = "aarch64")]
global_asm!(".globl _start", "_start:", "mov x29, xzr", "bl {main}", "brk 1", main = sym bare_main);

const STDERR: usize = 2;

/// What the tracker works in: memory of the program's own image, there is no other.
static mut STORAGE: drive::Storage = drive::Storage::EMPTY;

extern "C" fn bare_main() -> ! {
    // SAFETY: the program has one thread, and this is the only place that names the storage; it is reached once.
    let storage = unsafe { &mut *(&raw mut STORAGE) };
    match problems::solve_all().and_then(|()| drive::along_a_street(storage)) {
        Ok(()) => exit(0),
        Err(failed) => {
            print("no-std proof failed: ");
            print(failed);
            print("\n");
            exit(1)
        }
    }
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    print("no-std proof panicked\n");
    exit(101)
}

fn print(text: &str) {
    system_call(SYS_WRITE, STDERR, text.as_ptr() as usize, text.len());
}

fn exit(code: usize) -> ! {
    loop {
        system_call(SYS_EXIT, code, 0, 0);
    }
}

#[cfg(target_arch = "x86_64")]
const SYS_WRITE: usize = 1;
#[cfg(target_arch = "x86_64")]
const SYS_EXIT: usize = 60;
#[cfg(target_arch = "aarch64")]
const SYS_WRITE: usize = 64;
#[cfg(target_arch = "aarch64")]
const SYS_EXIT: usize = 93;

#[cfg(target_arch = "x86_64")]
fn system_call(number: usize, a: usize, b: usize, c: usize) {
    // SAFETY: `write` and `exit` are the only calls; `write` gets a live buffer with its length, and the kernel
    // clobbers rax, rcx and r11 only.
    unsafe {
        asm!("syscall", inlateout("rax") number => _, in("rdi") a, in("rsi") b, in("rdx") c,
             lateout("rcx") _, lateout("r11") _, options(nostack));
    }
}

#[cfg(target_arch = "aarch64")]
fn system_call(number: usize, a: usize, b: usize, c: usize) {
    // SAFETY: as on x86-64; the kernel clobbers x0 only.
    unsafe {
        asm!("svc 0", in("x8") number, inlateout("x0") a => _, in("x1") b, in("x2") c, options(nostack));
    }
}

/// The compiler calls these four by name. Volatile accesses keep it from turning a loop into a call of itself.
mod memory {
    /// Copies `n` bytes between areas that do not overlap.
    ///
    /// # Safety
    /// As C's `memcpy`: both areas are valid for `n` bytes.
    #[unsafe(no_mangle)]
    unsafe extern "C" fn memcpy(to: *mut u8, from: *const u8, n: usize) -> *mut u8 {
        for i in 0..n {
            // SAFETY: `i < n`, and the caller vouches for `n` bytes.
            unsafe { to.add(i).write_volatile(from.add(i).read_volatile()) };
        }
        to
    }

    /// Copies `n` bytes between areas that may overlap.
    ///
    /// # Safety
    /// As C's `memmove`: both areas are valid for `n` bytes.
    #[unsafe(no_mangle)]
    unsafe extern "C" fn memmove(to: *mut u8, from: *const u8, n: usize) -> *mut u8 {
        if (to as usize) <= from as usize {
            // SAFETY: forwards is right when the target starts first; the contract is the same.
            return unsafe { memcpy(to, from, n) };
        }
        for i in (0..n).rev() {
            // SAFETY: `i < n`, and the caller vouches for `n` bytes.
            unsafe { to.add(i).write_volatile(from.add(i).read_volatile()) };
        }
        to
    }

    /// Fills `n` bytes with the low byte of `value`.
    ///
    /// # Safety
    /// As C's `memset`: the area is valid for `n` bytes.
    #[unsafe(no_mangle)]
    unsafe extern "C" fn memset(to: *mut u8, value: i32, n: usize) -> *mut u8 {
        for i in 0..n {
            // SAFETY: `i < n`, and the caller vouches for `n` bytes.
            unsafe { to.add(i).write_volatile(value as u8) };
        }
        to
    }

    /// Order of two areas of `n` bytes.
    ///
    /// # Safety
    /// As C's `memcmp`: both areas are valid for `n` bytes.
    #[unsafe(no_mangle)]
    unsafe extern "C" fn memcmp(a: *const u8, b: *const u8, n: usize) -> i32 {
        for i in 0..n {
            // SAFETY: `i < n`, and the caller vouches for `n` bytes.
            let (left, right) = unsafe { (a.add(i).read_volatile(), b.add(i).read_volatile()) };
            if left != right {
                return i32::from(left) - i32::from(right);
            }
        }
        0
    }

    /// Whether two areas of `n` bytes differ.
    ///
    /// # Safety
    /// As C's `bcmp`: both areas are valid for `n` bytes.
    #[unsafe(no_mangle)]
    unsafe extern "C" fn bcmp(a: *const u8, b: *const u8, n: usize) -> i32 {
        // SAFETY: the same contract.
        unsafe { memcmp(a, b, n) }
    }
}
