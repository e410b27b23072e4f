"""Attempts as tasks of a Ray cluster, which places them and repeats those that fail."""

import logging
import os
import signal
from collections.abc import Generator, Iterable
from tempfile import TemporaryDirectory
from typing import Any

from capture.hardware import usable_cores
from capture.input_error import InputError
from instant_avatar.batching.batch_arguments import RAY_LOCAL, BatchArguments
from instant_avatar.batching.capture_discovery import BatchCapture
from instant_avatar.batching.ingest_attempt import (
    LOG_NAME,
    Attempt,
    AttemptFailure,
    learn_capture,
    record_of,
)

OBJECT_STORE_BYTES = 200_000_000
"""Memory for what attempts bring back (about 5 MB each), where this machine alone is used."""


def run_attempts(
    captures: Iterable[BatchCapture], arguments: BatchArguments
) -> Generator[Attempt, None, None]:
    """Learn captures, and yield the last attempt at each as it ends.

    Closing the iterator ends what runs.
    """
    import ray

    captures = list(captures)
    with TemporaryDirectory(prefix="ia-batch-") as folder:  # also of workers that are killed
        scratch = folder if arguments.ray == RAY_LOCAL else None
        _connect(ray, arguments.ray)
        try:
            memory = int(1e9 * arguments.memory)
            needs = {
                capture.name: {"num_cpus": arguments.cores_of(capture), "memory": memory}
                for capture in captures
            }
            _check_room(ray, needs.values())
            once: dict[str, Any] = {"max_calls": 1}  # each attempt has a process of its own
            retries = {"max_retries": arguments.retries, "retry_exceptions": [AttemptFailure]}
            task = ray.remote(**once, **retries)(learn_capture)
            running = {
                task.options(name=capture.name, **needs[capture.name]).remote(
                    capture, arguments, scratch
                ): capture
                for capture in captures
            }
            while running:
                (ended,), _ = ray.wait(list(running), num_returns=1)
                yield _attempt(ray, ended, running.pop(ended))
        finally:
            ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    """Connect to a cluster, or start one of this machine."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
    own: dict[str, Any] = {}
    if address == RAY_LOCAL:
        own = {"num_cpus": usable_cores(), "object_store_memory": OBJECT_STORE_BYTES}
        own["include_dashboard"] = False
    on_sigterm = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
    except Exception as error:  # a start that takes too long has no class of its own
        if address == RAY_LOCAL:
            raise InputError(
                f"Ray did not start on this machine ({error}). Is it busy? Run the command again."
            ) from error
        raise InputError(
            f"--ray {address}: there is no cluster to connect to ({error}). Start one: ray start "
            "--head; or omit --ray to use this machine alone."
        ) from error
    signal.signal(signal.SIGTERM, on_sigterm)  # Ray's own would print a stack and exit


def _check_room(ray: Any, needs: Iterable[dict[str, int]]) -> None:
    """Raise if a capture fits no node: its task would wait for ever."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    sizes = [(int(node.get("CPU", 0)), int(node.get("memory", 0))) for node in nodes]
    for need in needs:
        cores, memory = need["num_cpus"], need["memory"]
        if not any(cores <= most and memory <= available for most, available in sizes):
            present = ", ".join(f"{most} cores with {each / 1e9:.1f} GB" for most, each in sizes)
            raise InputError(
                f"No node has {cores} cores with {memory / 1e9:.1f} GB for a capture; there are "
                f"{present}. Lower --cores or --memory, or add a larger node."
            )


def _attempt(ray: Any, task: Any, capture: BatchCapture) -> Attempt:
    """Return the last attempt of a task that has ended."""
    try:
        return ray.get(task)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, AttemptFailure):
            return error.cause.attempt
        cause = f"{type(error.cause).__name__}: {error.cause}"
    except ray.exceptions.OutOfMemoryError:
        cause = "its node ran out of memory, and Ray ended the attempt"
    except ray.exceptions.RayError as error:
        cause = f"its process or its node was lost ({type(error).__name__})"
    return Attempt(record=record_of(capture, None, cause), files={LOG_NAME: cause.encode()})
