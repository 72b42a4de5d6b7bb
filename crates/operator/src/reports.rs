//! The pipe on which this process reports to its launcher. What the process prints is for the log, and never a report.

use std::fs::File;
use std::io::Write;
use std::os::fd::{BorrowedFd, FromRawFd, RawFd};
use std::sync::{Mutex, OnceLock, PoisonError};

use rustix::io::{FdFlags, fcntl_setfd};

use crate::diagnostics::print_diagnostic;
use crate::wiring::REPORTS_VARIABLE;

/// The pipe; `None` if the process was started without one.
static PIPE: OnceLock<Option<Mutex<File>>> = OnceLock::new();

/// Takes the pipe. To be called before this process starts a program, so that no program inherits it.
pub(crate) fn take() {
    pipe();
}

/// Writes a line of JSON to the pipe, or to stderr if there is none. Lines of two threads don't mix. A launcher that is gone
/// hears nothing.
pub(crate) fn write(json: &str) {
    let Some(pipe) = pipe() else {
        print_diagnostic(json);
        return;
    };
    let mut pipe = pipe.lock().unwrap_or_else(PoisonError::into_inner);
    let _ = pipe.write_all(format!("{json}\n").as_bytes());
}

fn pipe() -> Option<&'static Mutex<File>> {
    PIPE.get_or_init(|| opened(&std::env::var(REPORTS_VARIABLE).ok()?).map(Mutex::new)).as_ref()
}

/// The descriptor of this number, which no program will inherit.
fn opened(number: &str) -> Option<File> {
    let number: RawFd = number.parse().ok()?;
    if number <= libc::STDERR_FILENO {
        return None;
    }
    // SAFETY: a number at which nothing is open is refused by the kernel. The borrow ends with this function.
    fcntl_setfd(unsafe { BorrowedFd::borrow_raw(number) }, FdFlags::CLOEXEC).ok()?;
    // SAFETY: the launcher gave this process the descriptor for its reports, and this module alone uses it.
    Some(unsafe { File::from_raw_fd(number) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;
    use std::os::fd::IntoRawFd;

    #[test]
    fn no_program_of_this_process_holds_the_pipe() {
        let (mut reader, writer) = std::io::pipe().expect("a pipe");
        fcntl_setfd(&writer, FdFlags::empty()).expect("a descriptor that programs inherit");
        let mut pipe = opened(&writer.into_raw_fd().to_string()).expect("a descriptor");
        let mut program = std::process::Command::new("sleep").arg("600").spawn().expect("sleep");
        pipe.write_all(b"a report\n").expect("written");
        drop(pipe);
        let mut heard = String::new();
        // If `sleep` held the pipe, it would not end.
        reader.read_to_string(&mut heard).expect("read");
        program.kill().expect("killed");
        program.wait().expect("ended");
        assert_eq!(heard, "a report\n");
    }

    #[test]
    fn a_number_of_no_descriptor_is_not_taken() {
        for number in ["", "2", "-1", "three", "2147483647"] {
            assert!(opened(number).is_none(), "{number}");
        }
    }
}
