"""Several machines on one computer: network namespaces on a bridge, each with its own shared memory.

They have one clock, so that latencies need no correction. This needs root, iproute2 and util-linux, and changes nothing
outside of the namespaces.
"""

import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from . import graphs, programs

PORT = 7447
# Seconds after the expected end, for draining and for a busy computer.
GRACE_SECS = 60


class Network:
    """Hosts on a bridge. All their processes end with the block."""

    def __init__(self, n_hosts):
        self.n_hosts = n_hosts
        self.hosts = []
        self.processes = []

    def __enter__(self):
        try:
            switch = Host(self, 0)
            self.hosts.append(switch)
            switch.ip("link add br0 type bridge")
            switch.ip("link set br0 up")
            for idx in range(1, self.n_hosts + 1):
                host = Host(self, idx)
                self.hosts.append(host)
                switch.ip(f"link add p{idx} type veth peer name eth0 netns {host.pid}")
                switch.ip(f"link set p{idx} master br0 up")
                host.ip(f"addr add {host.address}/24 dev eth0")
                host.ip("link set eth0 up")
        except BaseException:
            self.__exit__()
            raise
        return self.hosts[1:]

    def __exit__(self, *_):
        # SIGINT lets a launcher end its operators.
        for patience_secs, number in (10, signal.SIGINT), (5, signal.SIGKILL):
            living = [process for process in self.processes if process.poll() is None]
            for process in living:
                process.send_signal(number)
            for process in living:
                try:
                    process.wait(patience_secs)
                except subprocess.TimeoutExpired:
                    pass
        for host in self.hosts:
            host.process.stdin.close()
            host.process.wait()


class Host:
    """A network namespace with its own shared memory. It is held by a process that ends when its stdin is closed."""

    def __init__(self, network, idx):
        self.network = network
        self.address = f"10.77.0.{idx}"
        # The sockets of graphs are in /tmp, whatever TMPDIR says.
        sockets = f"/tmp/blindgrasp-{os.getuid()}"
        own = f"mount -t tmpfs tmpfs /dev/shm && mkdir -p {sockets} && mount -t tmpfs -o mode=700 tmpfs {sockets}"
        prepare = f"{own} && mkdir /dev/shm/tmp && ip link set lo up && echo $$ && exec cat"
        command = ["unshare", "--net", "--mount", "--kill-child", "--fork", "sh", "-c", prepare]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        # Ctrl-C is for this program, not for the processes that it has started.
        self.process = subprocess.Popen(command, **pipes, text=True, start_new_session=True)
        line = self.process.stdout.readline().strip()
        if not line:
            self.process.stdin.close()
            self.process.wait()
            sys.exit("several machines on one need root, iproute2, util-linux, and a kernel with network namespaces")
        self.pid = int(line)

    def enter(self, *command):
        """A command in this host. It ends if this program is killed."""
        enter = ["nsenter", "--target", str(self.pid), "--net", "--mount", "setpriv", "--pdeathsig", "INT"]
        return [*enter, *map(str, command)]

    def ip(self, arguments):
        subprocess.run(self.enter("ip", *arguments.split()), check=True)

    def output(self, *command):
        words = self.enter(*command)
        done = subprocess.run(
            words, cwd=programs.PROJECT, env=self.environment(), check=True, capture_output=True, text=True
        )
        return done.stdout

    def start(self, *command):
        log = tempfile.TemporaryFile("w+")
        process = subprocess.Popen(
            self.enter(*command),
            cwd=programs.PROJECT,
            env=self.environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            start_new_session=True,
        )
        process.log = log
        self.network.processes.append(process)
        return process

    @staticmethod
    def environment():
        return os.environ | {"TMPDIR": "/dev/shm/tmp", "XDG_STATE_HOME": "/dev/shm/state"}

    def bytes_sent(self):
        """The bytes on this host's network so far, with Ethernet, IP and TCP."""
        devices = Path(f"/proc/{self.pid}/net/dev").read_text()
        return int(re.search(r"eth0:(.*)", devices)[1].split()[8])


def finish(process, limit_secs):
    """Waits for a process; its last line and the CPU time of it and its children."""
    deadline = time.monotonic() + limit_secs
    # The output is short and fits into the pipe.
    while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
        if time.monotonic() > deadline:
            fail(process, f"has not ended within {limit_secs:.0f} s")
        time.sleep(0.02)
    _, status, usage = ended
    process.returncode = os.waitstatus_to_exitcode(status)
    # 3 means finished with loss; the figures show the loss.
    if process.returncode not in (0, 3):
        fail(process, f"ended with exit code {process.returncode}")
    lines = process.stdout.read().splitlines()
    if not lines:
        fail(process, "said nothing")
    return lines[-1], usage.ru_utime + usage.ru_stime


def fail(process, what):
    process.log.seek(0)
    sys.exit(f"{shlex.join(process.args)} {what}:\n{process.log.read()}")


def steady_source(recording):
    """A node that sends one of a recording's frames over and over."""
    return {"on": "robot", "run": str(programs.EXAMPLES / "steady_source"), "params": {"recording": str(recording)}}


def on_machines(path, listen, link, operators):
    """A dataflow file of the machines robot and brain, of which brain listens."""
    return graphs.write_flow(path, operators, machines={"robot": {}, "brain": {"listen": listen}}, link=link)
