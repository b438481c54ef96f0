"""The laboratory, for researchers: evaluation, the systems compared, import of networks, and training."""

import core  # noqa: F401  it switches off what onnxruntime would report, before that is imported
