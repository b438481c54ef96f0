"""Place recognition: from frames to descriptors, maps and verdicts; knows nothing of HTTP."""

from core.threads import wait_briefly

wait_briefly()  # before anything here imports torch or FAISS, which read it when they load
