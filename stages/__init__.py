import os

# OpenMP's threads wait asleep: spinning, they take the processor from whatever else runs. Read by
# whichever library brings OpenMP first, so that it has to be said before all of them.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
