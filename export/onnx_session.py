"""onnxruntime as the player needs it: which provider, a session, and what it says."""

import onnxruntime

from capture.input_error import InputError

MIN_ORT_VERSION = "1.24"
IN_MEMORY_TABLES = "add_external_initializers_from_files_in_memory"
"""What older releases cannot do from Python."""


def find_provider(name: str) -> str:
    """onnxruntime's own name of a provider: "cpu" is "CPUExecutionProvider".

    Raises:
        InputError: If this onnxruntime has none of that name.
    """
    known = onnxruntime.get_available_providers()
    for provider in known:
        if name.lower() in (provider.lower(), provider.lower().removesuffix("executionprovider")):
            return provider
    short = ", ".join(provider.removesuffix("ExecutionProvider").lower() for provider in known)
    raise InputError(
        f"onnxruntime {onnxruntime.__version__} has no provider {name!r} here; it has: {short}. "
        "Others come with other builds of it, such as onnxruntime-gpu or onnxruntime-openvino."
    )


def shorten_error(error: Exception, max_length: int = 400) -> str:
    """What onnxruntime says, without the pages that some providers add."""
    said = " ".join(str(error).split())
    return (
        said
        if len(said) <= max_length
        else f"{said[: max_length // 2]} … {said[-max_length // 2 :]}"
    )


def create_session(
    graph: bytes, tables: dict[str, bytes], threads: int, provider: str
) -> onnxruntime.InferenceSession:
    """A graph that is ready to run, with threads that do not spin.

    Args:
        graph: The ONNX model.
        tables: Its external tables by name; they must live as long as the session.
        threads: Of one run.
        provider: As `find_provider` gives it.

    Raises:
        InputError: If it does not run here.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what fails is said below
    options.enable_mem_reuse = False  # planning it takes longer than anything else at load
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    names, buffers = list(tables), list(tables.values())
    if not hasattr(options, IN_MEMORY_TABLES):
        raise InputError(
            f"onnxruntime {onnxruntime.__version__} is too old for the player; {MIN_ORT_VERSION} or newer "
            "is needed: pip install --upgrade onnxruntime (or the build of it that you use)."
        )
    getattr(options, IN_MEMORY_TABLES)(names, buffers, [len(buffer) for buffer in buffers])
    wanted = list(dict.fromkeys([provider, "CPUExecutionProvider"]))  # what it lacks, the CPU does
    try:
        session = onnxruntime.InferenceSession(graph, options, providers=wanted)
    except Exception as error:
        raise InputError(
            f"The package's graph does not run on onnxruntime {onnxruntime.__version__} "
            f"({provider}): {shorten_error(error)}"
        ) from error
    if session.get_providers()[0] != provider:
        raise InputError(
            f"onnxruntime {onnxruntime.__version__} knows {provider} but could not start it here; "
            "it would draw on the CPU instead. Are the drivers and libraries installed?"
        )
    return session
