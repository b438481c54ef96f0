"""Place recognition: from frames to descriptors, maps and verdicts; knows nothing of HTTP."""

from core.silence import keep_silent
from core.threads import wait_briefly

keep_silent()  # before anything here imports ONNX Runtime, which reports from the moment on at which it loads
wait_briefly()  # before anything here imports torch or FAISS, which read it when they load
