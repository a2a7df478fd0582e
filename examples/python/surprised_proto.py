"""The messages of `proto/surprised/v1` as Python classes: `from surprised_proto import Frame, SurpriseReport`.

Compiled when imported (a tenth of a second), so that they always fit the protobuf that is installed; copy this file
together with the folder `proto`. To have generated files instead:

    python -m grpc_tools.protoc -I proto --python_out=. proto/surprised/v1/*.proto
"""

import tempfile
from pathlib import Path

import grpc_tools
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from grpc_tools import protoc

PROTO = Path(__file__).resolve().parents[2] / "proto"


def _classes(proto: Path) -> dict:
    files = [str(file) for file in sorted(proto.glob("surprised/v1/*.proto"))]
    google = str(Path(grpc_tools.__file__).parent / "_proto")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "descriptors"
        arguments = ["protoc", f"-I{proto}", f"-I{google}", "--include_imports", f"--descriptor_set_out={out}"]
        if not files or protoc.main(arguments + files) != 0:
            raise ImportError(f"cannot compile the messages in {proto}/surprised/v1")
        descriptors = descriptor_pb2.FileDescriptorSet.FromString(out.read_bytes())
    pool = descriptor_pool.DescriptorPool()
    for file in descriptors.file:
        pool.Add(file)
    classes = message_factory.GetMessageClassesForFiles([file.name for file in descriptors.file], pool)
    return {name.rpartition(".")[2]: cls for name, cls in classes.items()}


def encoding(message) -> str:
    """The Zenoh encoding that `surprised` asks for; a sample with another one is rejected."""
    return f"application/protobuf;{message.DESCRIPTOR.full_name}"


globals().update(_classes(PROTO))
