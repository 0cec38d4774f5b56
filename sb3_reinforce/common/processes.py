"""
Messages between the processes of a script that PyTorch's launcher has started.

PyTorch introduces the processes to each other. Messages go through one connection between process 0 and each other
process, since a call that waits in gloo answers no signal, has a timeout, and does not say which process has died.
"""

import os
import pickle
import secrets
import socket
import time
from contextlib import suppress
from datetime import timedelta
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Listener, wait
from typing import Any, cast

import torch.distributed as dist

from sb3_reinforce.common.interruptions import uninterrupted

# With the value 0, each process learns alone
SWITCH = "SB3_REINFORCE_PROCESSES"
# The cause of a signal arrives within this time
CAUSE_SECONDS = 0.5
# torchrun's SIGTERM arrives within this time after a process has ended
SIGTERM_SECONDS = 5.0


class ProcessError(RuntimeError):
    """Another process has stopped or died."""

    # Whether Ctrl-C or SIGTERM has stopped it
    is_interrupt = False


class Finished(Exception):
    """Process 0 has finished learning; the argument is its last state."""


def rank_and_size() -> tuple[int, int]:
    """The number of this process and W, the number of all, which learn together; (0, 1) if it learns alone."""
    if os.environ.get(SWITCH) != "0" and dist.is_available():
        if dist.is_initialized():
            return dist.get_rank(), dist.get_world_size()
        if dist.is_torchelastic_launched():
            return int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    return 0, 1


def is_leader() -> bool:
    """
    Whether this process is the one that learns, logs and saves: process 0 of a script under torchrun, or the only one.

    :return: False in the processes 1, 2, ... that ``python -m torch.distributed.run`` has started
    """
    return rank_and_size()[0] == 0


class Processes:
    """The connections of process 0 with the others; ``with`` makes and closes them, and sends on an error."""

    def __init__(self) -> None:
        if not dist.is_initialized():
            # Process 0 may evaluate for hours before it calls learn() again
            dist.init_process_group("gloo", timeout=timedelta(days=365))
        self.rank, self.size = rank_and_size()
        self.connections: dict[Any, int] = {}
        # Whether the others have yet to send their parts of a rollout
        self.in_round = False
        # What these parts started from
        self.state: Any = None
        self.waited = 0.0

    def __reduce__(self) -> Any:
        # A model that is saved or copied while it learns is alone
        return type(None), ()

    def connect(self) -> None:
        """Connect process 0 with each other process, which proves by a key that it belongs to the group."""
        # The port is open only while the processes connect
        dist.barrier()
        invitation: list[Any] = [None]
        if self.rank > 0:
            dist.broadcast_object_list(invitation, src=0)
            *address, key = invitation[0]
            connection = Client(tuple(address), authkey=key)
            connection.send(self.rank)
            self.connections[connection] = 0
        else:
            key = secrets.token_bytes(32)
            with Listener(("", 0), backlog=self.size, authkey=key) as listener:
                host = os.environ.get("MASTER_ADDR") or socket.gethostname()
                dist.broadcast_object_list([(host, listener.address[1], key)], src=0)
                while len(self.connections) < self.size - 1:
                    # A stranger may have found the port
                    with suppress(AuthenticationError, EOFError, OSError):
                        connection = listener.accept()
                        self.connections[connection] = connection.recv()
        for connection in self.connections:
            with socket.fromfd(connection.fileno(), socket.AF_INET, socket.SOCK_STREAM) as duplicate:
                # A message above 16 KB goes in two parts, and the second would wait 0.04 s for an acknowledgement
                duplicate.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: Any) -> None:
        """Send to all others, or to process 0; the next ``receive`` names a process that this does not reach."""
        # Plainly, since a connection's own pickling would move PyTorch's tensors to shared memory
        message = pickle.dumps(data)
        for connection in self.connections:
            with suppress(OSError):
                connection.send_bytes(message)

    def receive(self, timeout: float | None = None) -> list[Any]:
        """The next message of each other process by rank, or of process 0; an error that one sends is raised."""
        received: dict[int, Any] = {}
        start = time.perf_counter()
        missing = {*self.connections}
        while missing and (ready := wait(missing, timeout)):
            for connection in cast(Any, ready):
                rank = self.connections[connection]
                try:
                    # The next message must begin where this one ends
                    with uninterrupted:
                        data = pickle.loads(connection.recv_bytes())
                except (EOFError, OSError, pickle.UnpicklingError) as error:
                    message = f"Process {rank} of {self.size} has died, or ended without a message"
                    raise ProcessError(message) from error
                if isinstance(data, Exception):
                    raise data
                received[rank] = data
                missing.remove(connection)
        self.waited += time.perf_counter() - start
        return [received[rank] for rank in sorted(received)]

    def exchange(self, data: Any) -> list[Any]:
        """The data of all processes in every process, in their order."""
        if self.rank == 0:
            everything = [data, *self.receive()]
            self.send(everything)
        else:
            self.send(data)
            [everything] = self.receive()
        return everything

    def finish(self, state: Any) -> None:
        """Tell the others that learning has ended; parts of a rollout that a callback stopped are received first."""
        if self.in_round:
            self.receive()
        self.send(Finished(state))

    def __enter__(self) -> "Processes":
        try:
            self.connect()
        except BaseException as error:
            self.__exit__(type(error), error, None)
            raise
        self.started = time.perf_counter()
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        try:
            if error is not None:
                self.fail(error)
        finally:
            for connection in self.connections:
                connection.close()

    def fail(self, error: BaseException) -> None:
        """Send an error to the others; if another process's error has caused it, send and raise that one."""
        # BadData is an internal ValueError
        name = "ValueError" if isinstance(error, ValueError) else type(error).__name__
        reason = f"{name}: {error}".removesuffix(": ")
        message = ProcessError(f"Process {self.rank} of {self.size} has stopped: {reason}")
        message.is_interrupt = isinstance(error, KeyboardInterrupt)
        if message.is_interrupt:
            # torchrun sends SIGTERM after another process has ended, by an error or interrupted like this one
            try:
                self.receive(CAUSE_SECONDS)
            except Exception as cause:
                if isinstance(cause, ProcessError) and not cause.is_interrupt:
                    self.send(cause)
                    raise cause from error
        self.send(error if isinstance(error, ProcessError) else message)
        if isinstance(error, ProcessError) and dist.is_torchelastic_launched():
            # Later its SIGTERM would interrupt the script while it saves the model
            with suppress(KeyboardInterrupt):
                time.sleep(SIGTERM_SECONDS)
