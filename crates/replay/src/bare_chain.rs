//! What passing samples along costs on this machine without blindgrasp: threads that hand datagrams on over unix sockets.
//! A latency in these terms says more than in microseconds: it is about the same on a fast machine and on a slow one.

use std::os::unix::net::UnixDatagram;
use std::time::{Duration, Instant};

/// As large as a tactile frame of a hundred cells.
const N_BYTES: usize = 1024;
/// A message that ends the chain.
const END: [u8; 1] = [0];

/// How long each message takes from the first to the last of `n_threads` threads, in nanoseconds; `pauses` lie before the
/// messages. Ends early when `should_stop` says so.
///
/// # Errors
/// The system's, about sockets and threads.
pub fn latencies_nanos(
    n_threads: usize,
    pauses: &[Duration],
    should_stop: &dyn Fn() -> bool,
) -> std::io::Result<Vec<u64>> {
    let pairs: Vec<_> = (1..n_threads.max(2)).map(|_| UnixDatagram::pair()).collect::<Result<_, _>>()?;
    let (mut senders, mut receivers): (Vec<_>, Vec<_>) = pairs.into_iter().unzip();
    // The first thread is this one; each of the others receives from the one before.
    let first = senders.remove(0);
    let Some(last) = receivers.pop() else { return Ok(Vec::new()) };
    let start = Instant::now();
    std::thread::scope(|scope| {
        for (from, to) in receivers.into_iter().zip(senders) {
            scope.spawn(move || pass_on(&from, &to));
        }
        let arrivals = scope.spawn(move || arrivals(&last, start));
        let sent = send(&first, start, pauses, should_stop);
        // An end that nobody reads any more is one, too: closing the socket wakes whoever waits.
        let ended = first.send(&END).map(|_| ());
        drop(first);
        let received = arrivals.join().map_err(|_| std::io::Error::other("a thread of the bare chain panicked"))?;
        sent.and(ended).and(received)
    })
}

/// The middle one of an odd number, the lower middle one of an even number.
pub fn median(mut nanos: Vec<u64>) -> Option<u64> {
    nanos.sort_unstable();
    nanos.get(nanos.len().saturating_sub(1) / 2).copied()
}

fn send(to: &UnixDatagram, start: Instant, pauses: &[Duration], should_stop: &dyn Fn() -> bool) -> std::io::Result<()> {
    let mut due = start;
    let mut message = [0; N_BYTES];
    for pause in pauses {
        due += *pause;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        if should_stop() {
            return Ok(());
        }
        message[..8].copy_from_slice(&(start.elapsed().as_nanos() as u64).to_le_bytes());
        to.send(&message)?;
    }
    Ok(())
}

fn pass_on(from: &UnixDatagram, to: &UnixDatagram) -> std::io::Result<()> {
    let mut message = [0; N_BYTES];
    loop {
        let n_bytes = from.recv(&mut message)?;
        to.send(&message[..n_bytes])?;
        if n_bytes < N_BYTES {
            return Ok(());
        }
    }
}

fn arrivals(from: &UnixDatagram, start: Instant) -> std::io::Result<Vec<u64>> {
    let mut message = [0; N_BYTES];
    let mut latencies = Vec::new();
    while from.recv(&mut message)? == N_BYTES {
        let mut sent = [0; 8];
        sent.copy_from_slice(&message[..8]);
        latencies.push((start.elapsed().as_nanos() as u64).saturating_sub(u64::from_le_bytes(sent)));
    }
    Ok(latencies)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_message_arrives_and_takes_time() {
        for n_threads in [2, 5] {
            let latencies = latencies_nanos(n_threads, &[Duration::from_micros(50); 40], &|| false).expect("sockets");
            assert_eq!(latencies.len(), 40);
            assert!(latencies.iter().all(|nanos| *nanos > 0));
        }
        assert_eq!(latencies_nanos(3, &[Duration::ZERO; 9], &|| true).expect("sockets"), Vec::<u64>::new());
    }

    #[test]
    fn the_median_is_one_of_them() {
        assert_eq!(median(vec![5, 1, 3]), Some(3));
        assert_eq!(median(vec![4, 1, 3, 2]), Some(2));
        assert_eq!(median(vec![]), None);
    }
}
