"""Settings of the process that a plug-in changes when it is imported are named, and put back."""

from __future__ import annotations

import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from cavbench.errors import EscapeError
from cavbench.isolation.foreign import harm, unchanged
from cavbench.isolation.settings import Settings

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="there is a copy of the process on Linux only")
ADOPTS = "import ctypes; adopts = ctypes.c_int(); ctypes.CDLL(None).prctl(37, ctypes.byref(adopts), 0, 0, 0)"
PUT_BACK = {
    "import sys; sys.setrecursionlimit(len(__import__('inspect').stack()) + 25)": "the recursion limit",
    "import sys; sys.setrecursionlimit(10**6)": "the recursion limit",
    "import sys; sys.setswitchinterval(5)": "the switch interval of threads",
    "import sys; sys.settrace(lambda *_: None)": "the trace function",
    "import sys; sys.set_int_max_str_digits(0)": "the most digits of a number",
    "import gc; gc.disable()": "the garbage collector",
    "import os; os.chdir('/')": "the current folder",
    "import os; os.umask(0)": "the umask",
    "import os; os.environ['PYTHONHASHSEED'] = '1'": "environment variables",
    "import os; os.environ['HOME'] = '/'": "environment variables",
    "import os; os.environ.pop('PATH')": "environment variables",
    "import locale; locale.setlocale(locale.LC_ALL, 'C' if locale.setlocale(locale.LC_ALL) != 'C' else 'C.UTF-8')": "the locale",
    "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)": "signal handlers",
    "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})": "the cores of the process",
    "import sys; del sys.path[0]": "the import path",
    "import sys; sys.path.reverse()": "the import path",
    "import sys; sys.meta_path.clear()": "how Python imports",
    "import sys, types; sys.modules['cavbench.errors'] = types.ModuleType('cavbench.errors')": "modules of the framework",
    "import builtins; builtins.open = print": "functions of Python",
    "import builtins; builtins.__import__ = lambda *_, **__: None": "functions of Python",
    "import sys; sys.stderr = sys.stdout": "standard input or output",
    "import warnings; warnings.simplefilter('error')": "the filters of warnings",
    "import warnings; warnings.resetwarnings()": "the filters of warnings",
    "import socket; socket.setdefaulttimeout(1)": "the timeout of connections",
    "import numpy; numpy.seterr(all='raise')": "the error state of numpy",
    "import torch; torch.set_default_dtype(torch.float64)": "the default type of torch",
    "import torch; torch.set_default_device('meta')": "the default device of torch",
    "import torch; torch.set_grad_enabled(False)": "the gradient mode of torch",
    "import torch; torch.set_autocast_enabled('cpu', True)": "the automatic types of torch",
    "import torch; torch.autograd.set_detect_anomaly(True)": "the anomaly mode of torch",
    "import torch; torch.use_deterministic_algorithms(True)": "the deterministic mode of torch",
    "import torch; torch.set_float32_matmul_precision('medium')": "the precision of torch",
    "import torch; torch.set_num_threads(7)": "the threads of torch",
    "import torch; torch.backends.cudnn.benchmark = True": "the backends of torch",
    "import torch; torch.backends.mkldnn.enabled = False": "the backends of torch",
    "import torch; torch.set_flush_denormal(True)": "how the processor rounds",
    "import ctypes, platform; ctypes.CDLL(None).fesetround(0x800 if platform.machine() == 'x86_64' else 0x400000)":
        "how the processor rounds",
    "import signal; signal.alarm(60)": "timers of the process",
    "import signal; signal.setitimer(signal.ITIMER_PROF, 60)": "timers of the process",
    "import signal; signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})": "the blocked signals",
    f"{ADOPTS}; ctypes.CDLL(None).prctl(36, not adopts.value, 0, 0, 0)": "whether the process adopts others",
    "import gc; gc.set_threshold(1)": "the garbage collector",
    "import threading; threading.settrace(print)": "the trace function of new threads",
    "import threading; threading.setprofile(print)": "the profile function of new threads",
    "import threading; threading.stack_size(65536)": "the stack of new threads",
    "import tracemalloc; tracemalloc.start()": "whether memory is traced",
    "import tempfile; tempfile.tempdir = '/'": "the folder for temporary files",
    "import sys; sys.executable = '/bin/false'": "the program of Python",
    "import multiprocessing; multiprocessing.set_executable('/bin/false')": "the program of Python",
    "import os; os.environ = dict(os.environ)": "what holds environment variables",
    "import codecs; codecs.register_error('strict', lambda error: ('', error.end))": "how text is encoded",
    "import copyreg, re; copyreg.pickle(re.Pattern, lambda pattern: (str, ('',)))": "how objects are pickled",
    "import warnings; warnings.showwarning = print": "how warnings are shown",
    "import sys; sys.stdout.write = print": "how standard input or output writes",
}  # fmt: skip
STAYS = {
    "import sys; sys.stdout.close()": "changes whether standard input or output is closed",
    "import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))": "changes limits of the process",
    "import os; os.nice(3)": "changes the priority of the process",
    "import os; os.closerange(3, 4096)": "closes files of the process",
    "import os; os.close(2)": "changes open files of the process",
    "import os; os.dup2(os.open('/dev/null', 1), 1); os.dup2(os.open('/dev/zero', 0), 2)": "changes open files of the process",
    "import threading, time; threading.Thread(target=time.sleep, args=(99,)).start()": "changes the threads that hold the end",
    "import torch; torch.nn.modules.module.register_module_forward_hook(print)":
        "changes the modes of torch, the hooks of all modules of torch",
    "import torch; torch.overrides.TorchFunctionMode().__enter__()": "changes the default device of torch, the modes of torch",
    "import atexit, time; atexit.register(time.sleep, 99)": "leaves a hook for the end of the process that does not end within",
    "import subprocess; subprocess.Popen(['sleep', '99'])": "leaves a process that outlives the command (sleep)",
    "import subprocess; subprocess.Popen(['sleep', '98'], start_new_session=True)": "leaves a process that outlives the command",
    "import os, time; os.fork() or os.fork() or (os.setsid(), time.sleep(99))": "leaves a process that outlives the command",
    "import os; os._exit(0)": "ends the process (exit code 0)",
    "import atexit, os; atexit.register(os._exit, 0)": "leaves a hook for the end of the process that ends it at once",
    "import os; os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))": "changes how the process is scheduled",
    "import ctypes; ctypes.CDLL(None).prctl(1, 9, 0, 0, 0)": "changes what ends the process with its parent",
    "import torch; torch.autograd.graph.saved_tensors_hooks(abs, abs).__enter__()": "changes the modes of torch",
    "import os; os.set_blocking(1, not os.get_blocking(1))": "changes whether standard input or output waits",
    "import sys; sys.addaudithook(lambda *_: None)": "adds an audit hook, which cannot be removed",
    "import pyarrow.parquet; pyarrow.parquet.write_table = print": "replaces pyarrow.parquet.write_table",
    "import subprocess; subprocess.Popen.kill = print": "replaces subprocess.Popen.kill",
}  # fmt: skip
HONEST = (
    "import os; os.environ['PYGAME_HIDE_SUPPORT_PROMPT'] = '1'; os.environ.setdefault('OMP_PROC_BIND', 'false')",
    "import sys; sys.path.append('/nowhere'); sys.path.insert(0, '/nowhere')",
    "import warnings; warnings.filterwarnings('ignore', category=DeprecationWarning)",
    "import atexit; atexit.register(print, 'bye')",
    "import torch, numpy, random; torch.manual_seed(1); numpy.random.seed(1); random.seed(1)",
    "import threading, time; threading.Thread(target=time.sleep, args=(99,), daemon=True).start()",
    "import highway_env, cv2, ray, art, stable_baselines3, onnxruntime, mitsuba, matplotlib.pyplot, sklearn",
    "import subprocess; subprocess.run(['true'])",
    "import atexit, subprocess; atexit.register(subprocess.Popen(['sleep', '97']).kill)",
    "1 / 0",
)


def sleepers() -> list[str]:
    """The processes that sleep for as long as those of these tests, whoever is their parent."""
    commands = []
    for one in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(FileNotFoundError, ProcessLookupError):  # it may end between its listing and its reading
            commands.append(one.read_bytes().split(b"\0"))
    return [repr(one) for one in commands if one[:1] == [b"sleep"] and one[1:2] in ([b"97"], [b"98"], [b"99"])]


def executed(code: str) -> None:
    exec(code, {"__name__": "plugin"})


@pytest.mark.parametrize("code", PUT_BACK)
def test_a_changed_setting_is_named_and_put_back(code: str) -> None:
    before = Settings()
    with pytest.raises(EscapeError) as raised, unchanged():
        executed(code)
    assert str(raised.value).startswith(f"it changes {PUT_BACK[code]}")
    assert before.changed() == ""


@LINUX
@pytest.mark.parametrize("code", [*PUT_BACK, *STAYS])
def test_what_an_import_would_change_is_noticed_in_a_copy_of_the_process(
    code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cavbench.isolation.foreign.END_S", 0.5)
    before = Settings(alone=True)
    found = harm(partial(executed, code), stays=True)
    wanted = STAYS.get(code, f"changes {PUT_BACK.get(code)}")
    assert found.startswith(wanted)
    assert bool(found) == bool(wanted)
    assert before.changed() == ""
    assert not sleepers()


@LINUX
@pytest.mark.parametrize("code", HONEST)
def test_what_libraries_do_when_they_are_imported_is_allowed(code: str) -> None:
    assert harm(partial(executed, code), stays=True) == ""


def test_what_raises_is_put_back_too(tmp_path: Path) -> None:
    before = Settings()
    with pytest.raises(ZeroDivisionError), unchanged():
        executed("import os; os.chdir('/'); 1 / 0")
    assert before.changed() == ""
