"""MuJoCo's compiler on documents that were refused: run as a script in a child process.

    python -I hostile_child.py MJCF_CHILD FOLDER sealed|open < documents

Documents are lines of JSON (text, part, suffix). Each goes to the compiler all the
same, in FOLDER, where its paths lead outside; a line of JSON says what mass it has.
"""

import importlib.util
import json
import os
import sys

import mujoco

path, folder, way = sys.argv[1:]
spec = importlib.util.spec_from_file_location("mjcf_child", path)
child = importlib.util.module_from_spec(spec)
spec.loader.exec_module(child)
mujoco.set_mju_user_warning(lambda text: None)
documents = [json.loads(line) for line in sys.stdin]
with open(os.path.join(folder, "inner.stl"), "rb") as file:
    inner = file.read()
os.chdir(folder)
if way == "sealed":
    child.forbid_files()
for each in documents:
    texts = {} if each["part"] is None else {"part.xml": each["part"].encode("latin-1")}
    text = each["text"].encode("latin-1").decode("utf-8", errors="replace")
    model = {"main": text, "suffix": each["suffix"], "texts": texts}
    try:
        made = child.general(child.spec_of(model | {"assets": {"inner.stl": inner}}))
        masses = made.body_mass.tolist()
    except (ValueError, TypeError, mujoco.FatalError):
        masses = []
    print(json.dumps(masses))
