"""Process inside the namespaces of a program: `python -m skytether.shell.driving.inside FD MTU CMD
ARG…`.

The process makes namespaces of network, mounts and processes, and in them a process with number 1.
Process 1 opens the only network device, sends it to netem through the socket FD, and runs the
program. When process 1 ends, the kernel ends all processes of the namespaces, network and device.
Process 1 ends when the socket closes, for example because netem was killed.

This module imports few modules of the package, because it is started with each program.
"""

import ctypes
import os
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from errno import EACCES, ENOSPC, EPERM
from pathlib import Path

from skytether.shared.base.packets import ADDRESS, ADDRESS6, RESOLVER
from skytether.shell.host import system

READY, START, ENDED, ALL_ENDED = b"ready", b"start", b"ended", b"all ended"
"""Messages: ready, with the device; start the program; the program has ended, with its wait status;
all its processes have ended. Other messages to netem are errors, others from netem signal numbers.
"""
LINGER_S = 10.0
"""Longest wait after the program's end until its TCP connections have sent their data [s]."""
LOOK_EVERY_S = 0.02
CLOSING = ("04", "09", "0B")
"""States in /proc/net/tcp of a connection with data or a FIN under way: FIN_WAIT1, LAST_ACK,
CLOSING."""
QUEUE = 10_000
"""Number of packets that the device queues for netem; large, so that no burst is lost here."""
RESOLVERS = ("/run/nscd", "/run/systemd/resolve")
"""Folders of sockets through which this machine resolves names for programs."""
FORBIDDEN = (EACCES, EPERM, ENOSPC)
"""Errors if the system or a container allows no namespaces, or no more of them (ENOSPC)."""
ADMIN = ":/usr/local/sbin:/usr/sbin:/sbin"
"""Folders of administration programs, which are not in the PATH of ordinary users."""

_NEWNS, _NEWUSER, _NEWPID, _NEWNET = 0x00020000, 0x10000000, 0x20000000, 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_MS_BIND, _MS_REC, _MS_PRIVATE = 0x1000, 0x4000, 0x40000
_PR_SET_PDEATHSIG, _PR_CAP_AMBIENT = 1, 47
_CAPABILITY_VERSION_3, _CAP_NET_ADMIN, _RAISE, _CLEAR_ALL = 0x20080522, 12, 2, 4

_libc = system.LIBC


def main(argv: Sequence[str]) -> int:
    control, mtu, command = socket.socket(fileno=int(argv[0])), int(argv[1]), argv[2:]
    control.set_inheritable(False)
    _end_with_parent()
    # Signals are blocked, so that `_pass_on` sees which signals this process has received itself.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    try:
        _enter()
        first = os.fork()
    except OSError as error:
        return _fail(
            control, f"this process may not make namespaces ({error.strerror}){_how(error)}"
        )
    if first:
        control.close()
        os.waitpid(first, 0)
        return 0
    _end_with_parent()
    try:
        device = _open_device()
        _configure(mtu)
        _mount()
    except OSError as error:
        what = error.filename or "the program's namespaces"
        return _fail(control, f"{what}: {error.strerror}{_how(error)}")
    except subprocess.CalledProcessError as error:
        return _fail(control, f"ip: {error.stderr.decode(errors='replace').strip()}")
    socket.send_fds(control, [READY], [device])
    os.close(device)
    if control.recv(len(START)) == START:
        program = os.fork()
        if not program:
            _run(command, mask)
        _wait(control, program)
    return 0


def _end_with_parent() -> None:
    """Let the kernel kill this process when the parent ends; new credentials would undo this."""
    _call(_libc.prctl, _PR_SET_PDEATHSIG, signal.SIGKILL)


def _fail(control: socket.socket, message: str) -> int:
    control.send(message.encode())
    return 1


def _how(error: OSError) -> str:
    """Advice on how to avoid an error; empty if there is none."""
    if not Path("/dev/net/tun").exists():
        return "; there is no /dev/net/tun (modprobe tun; in a container --device /dev/net/tun)"
    if error.errno not in FORBIDDEN:
        return ""
    if os.geteuid() == 0:
        return "; root needs CAP_SYS_ADMIN and CAP_NET_ADMIN (in a container --privileged)"
    return (
        "; allow user namespaces (sysctl kernel.apparmor_restrict_unprivileged_userns=0 on Ubuntu, "
        "kernel.unprivileged_userns_clone=1 on Debian), or run as root"
    )


def _enter() -> None:
    """Enter new namespaces; an ordinary user becomes the same user of a user namespace.

    Raises:
        OSError: the kernel, or a container, does not allow new namespaces.
    """
    uid, gid = os.geteuid(), os.getegid()
    flags = _NEWNET | _NEWNS | _NEWPID
    _call(_libc.unshare, flags if uid == 0 else flags | _NEWUSER)
    if uid:
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"{uid} {uid} 1")
        Path("/proc/self/gid_map").write_text(f"{gid} {gid} 1")


def _open_device() -> int:
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    system.fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", b"netem", _IFF_TUN | _IFF_NO_PI))
    return device


def _configure(mtu: int) -> None:
    """Bring the device up without a link-local address, so that the kernel sends no packets."""
    with _handing_down():
        _ip(
            "link set lo up",
            "link set netem addrgenmode none",
            f"link set netem mtu {mtu} txqueuelen {QUEUE} up",
            f"addr add {ADDRESS}/24 dev netem",
            "route add default dev netem",
        )
        with suppress(subprocess.CalledProcessError):  # a kernel without IPv6
            _ip(f"addr add {ADDRESS6}/64 dev netem nodad", "route add ::/0 dev netem")
    # Allow ping and ports below 1024, because file capabilities have no effect in the namespaces.
    group = os.getegid()
    for name, value in (
        ("ping_group_range", f"{group} {group}"),
        ("ip_unprivileged_port_start", 0),
    ):
        with suppress(OSError):
            Path("/proc/sys/net/ipv4", name).write_text(str(value))


@contextmanager
def _handing_down() -> Iterator[None]:
    """In the block, let `ip` configure the network, even if an ordinary user has started netem."""
    header, own = struct.pack("Ii", _CAPABILITY_VERSION_3, 0), ctypes.create_string_buffer(24)
    _call(_libc.capget, header, own)
    effective, permitted, inheritable, *others = struct.unpack("6I", own.raw)
    inheritable |= 1 << _CAP_NET_ADMIN
    _call(_libc.capset, header, struct.pack("6I", effective, permitted, inheritable, *others))
    _call(_libc.prctl, _PR_CAP_AMBIENT, _RAISE, _CAP_NET_ADMIN, 0, 0)
    yield
    _call(_libc.prctl, _PR_CAP_AMBIENT, _CLEAR_ALL, 0, 0, 0)
    _call(_libc.capset, header, own.raw)


def _ip(*lines: str) -> None:
    found = shutil.which("ip", path=os.environ.get("PATH", "") + ADMIN)
    if found is None:
        raise subprocess.CalledProcessError(127, "ip", stderr=b"it is missing; install iproute2")
    text = "".join(line + "\n" for line in lines).encode()
    subprocess.run([found, "-batch", "-"], input=text, check=True, capture_output=True)


def _mount() -> None:
    """Mount a /proc of the program's processes, and a resolv.conf with slirp4netns's resolver."""
    _call(_libc.mount, b"none", b"/", None, _MS_REC | _MS_PRIVATE, None)
    with suppress(OSError):  # a container may hide parts of /proc, which then stays unchanged
        _call(_libc.mount, b"proc", b"/proc", b"proc", 0, None)
    path = Path("/etc/resolv.conf")
    before = path.read_text() if path.exists() else ""
    kept = [line for line in before.splitlines() if not line.startswith("nameserver")]
    text = "\n".join((f"nameserver {RESOLVER}", *kept, ""))
    for folder in filter(os.path.isdir, RESOLVERS):
        _call(_libc.mount, b"tmpfs", folder.encode(), b"tmpfs", 0, None)
    real = path.resolve()
    if not real.exists():  # nothing to mount over: this machine resolves no names
        if str(real.parent) in RESOLVERS:  # the mount above made the folder private
            real.write_text(text)
        return
    if text == before:  # as within another `netem run`, where it cannot be mounted over
        return
    with tempfile.NamedTemporaryFile("w") as file:  # the file is deleted, its mount remains
        file.write(text)
        file.flush()
        Path(file.name).chmod(0o644)
        _call(_libc.mount, file.name.encode(), os.fsencode(real), None, _MS_BIND, None)


def _run(command: Sequence[str], mask: Iterable[int]) -> None:
    """Replace this process by the program, with the signal mask that netem started with."""
    for number in (signal.SIGPIPE, signal.SIGXFSZ, signal.SIGUSR1):
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    try:
        os.execvp(command[0], list(command))
    except OSError as error:
        print(f"netem run: {command[0]}: {error.strerror}", file=sys.stderr, flush=True)
        os._exit(127 if isinstance(error, FileNotFoundError) else 126)  # exit codes of a shell


def _wait(control: socket.socket, program: int) -> None:
    """Tell netem when the program has ended, and when all processes that it started have ended."""
    woken, wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
    is_running, are_left, linger_s = True, True, LINGER_S
    while True:
        while are_left:
            try:
                process, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                are_left = False
                break
            if process == program:
                is_running = False
                control.send(ENDED + struct.pack("<i", status))
            elif not process:
                break
        if not are_left and linger_s > 0.0:
            linger_s = linger_s - LOOK_EVERY_S if _is_closing() else 0.0
            if linger_s <= 0.0:
                control.send(ALL_ENDED)
        wait_s = LOOK_EVERY_S if not are_left and linger_s > 0.0 else None
        ready, _, _ = select.select([control.fileno(), woken], [], [], wait_s)
        if woken in ready:
            with suppress(BlockingIOError):
                os.read(woken, 4096)
        if control.fileno() in ready:
            message = control.recv(1)
            if not message or not is_running:
                return
            _pass_on(message[0], program)


def _pass_on(number: int, program: int) -> None:
    """Send the program a signal that netem received, unless the program has received it itself.

    A terminal, or `kill` of a process group, sends a signal to netem, to the program and to this
    process, where the signal is blocked and therefore pending.
    """
    if signal.sigtimedwait([number], 0) is None:
        os.kill(program, number)


def _is_closing() -> bool:
    for name in ("tcp", "tcp6"):
        with suppress(OSError):
            lines = Path("/proc/net", name).read_text().splitlines()[1:]
            if any(line.split()[3] in CLOSING for line in lines):
                return True
    return False


def _call(function: "ctypes._FuncPointer", *arguments: object) -> None:
    """Call libc.

    Raises:
        OSError: the call failed.
    """
    if function(*arguments) < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


if __name__ == "__main__":
    with suppress(ConnectionError):  # netem has ended
        sys.exit(main(sys.argv[1:]))
