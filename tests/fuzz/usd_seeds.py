"""First inputs of the readers of USD: what the schema allows, and what gsopt refuses.

The fuzzer sees no code of Pixar's library, hence no progress in its grammar: valid files lead it to the lines behind.
"""

from __future__ import annotations

from pathlib import Path

HEAD = '#usda 1.0\n(\n    defaultPrim = "s"\n    upAxis = "Y"\n)\n'
Z_UP = '#usda 1.0\n(\n    upAxis = "Z"\n    metersPerUnit = 0.01\n)\n'
NOTES = """#usda 1.0
(
    customLayerData = {
        dictionary gsopt = {
            double meters_per_unit = 0.5
            double[] origin = [500000.5, -4000000, 12]
        }
    }
)
"""
DEGREE = "uniform int radiance:sphericalHarmonicsDegree = "
ONE = f"point3f[] positions = [(1, 2, 3)]\n{DEGREE}0\n"
FULL = f"""float3[] extent = [(-1, -1, -1), (1, 1, 1)]
quatf[] orientations = [(1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5)]
float3[] scales = [(0.1, 0.2, 0.3), (1, 1e-9, 0)]
float[] opacities = [0.5, 1]
point3f[] positions = [(1, 2, 3), (-1, 0, 1e6)]
{DEGREE}1
float3[] radiance:sphericalHarmonicsCoefficients = [{", ".join(["(0.5, -1, 2)"] * 8)}]
"""
HALF = f"""quath[] orientationsh = [(1, 0, 0, 0)]
half3[] scalesh = [(0.1, 0.2, 0.3)]
half[] opacitiesh = [0.5]
point3h[] positionsh = [(1, 2, 3)]
half3[] radiance:sphericalHarmonicsCoefficientsh = [(0.5, -1, 2)]
{DEGREE}0
"""
SHORT = f"{ONE}float[] opacities = []\nfloat3[] scales = [(1, 1, 1)]\nquatf[] orientations = []\n"
HIGH = (
    f"point3f[] positions = [(1, 2, 3)]\n{DEGREE}4\n"
    f"float3[] radiance:sphericalHarmonicsCoefficients = [{', '.join(['(0, 1, 2)'] * 25)}]\n"
)
BAD = (
    f"point3f[] positions = [(nan, inf, -inf)]\n{DEGREE}0\nfloat[] opacities = [-1]\nfloat3[] scales = [(-1, 0, inf)]\n"
)
WRONG_TYPES = f'string[] positions = ["x"]\n{DEGREE}-1\n'
TIMED = f"point3f[] positions.timeSamples = {{\n 0: [(1, 2, 3)],\n 1: [(4, 5, 6)],\n}}\n{DEGREE}0\n"
VARIANT = """def "s" (
    variants = {
        string v = "a"
    }
    prepend variantSets = "v"
)
{
    variantSet "v" = {
        "a" {
SPLATS
        }
    }
}
"""
MATRIX = "matrix4d xformOp:transform = ( (0, 2, 0, 0), (-2, 0, 0, 0), (0, 0, 2, 0), (5, 6, 7, 1) )\n"
TRANSFORM = f'{MATRIX}uniform token[] xformOpOrder = ["xformOp:transform"]\n'
SHEAR = 'float3 xformOp:scale = (1, 2, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]\n'
TURN = (
    "double3 xformOp:translate = (1, 2, 3)\nfloat3 xformOp:rotateXYZ = (30, 0, 90)\nfloat3 xformOp:scale = (-2, 2, 2)\n"
    'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]\n'
)


def splats(body: str, name: str = "s") -> str:
    return f'def ParticleField3DGaussianSplat "{name}"\n{{\n{body}}}\n'


def inside(body: str, prims: str) -> str:
    return f'def Xform "w"\n{{\n{body}{prims}}}\n'


TEXTS = (
    HEAD + splats(FULL),
    HEAD + splats(HALF),
    HEAD + splats(SHORT),
    HEAD + splats(HIGH),
    HEAD + splats(BAD),
    HEAD + splats(WRONG_TYPES),
    HEAD + splats(TIMED),
    NOTES + splats(ONE),
    Z_UP + inside(TRANSFORM, splats(ONE)),
    Z_UP + inside(TURN, splats(ONE) + splats(FULL, "t")),
    HEAD + inside(SHEAR, splats(ONE)),
    HEAD + splats(ONE) + splats(HALF, "t"),
    HEAD + 'def Sphere "s"\n{\n}\n',
    HEAD + f'class "c"\n{{\n{ONE}}}\ndef ParticleField3DGaussianSplat "s" (\n    inherits = </c>\n)\n{{\n}}\n',
    "#usda 1.0\n(\n    subLayers = [@a.usda@]\n)\n",
    '#usda 1.0\ndef "x" (references = @b.usda@</s>) {}\n',
    HEAD + VARIANT.replace("SPLATS", splats(ONE, "t")),
)


def usd_texts(folder: Path) -> list[bytes]:
    return [text.encode() for text in TEXTS]


def usd_binaries(folder: Path) -> list[bytes]:
    """The same stages in the binary form."""
    from pxr import Sdf

    found = []
    for number, text in enumerate(TEXTS):
        layer = Sdf.Layer.CreateAnonymous(".usda")
        assert layer.ImportFromString(text), text
        path = folder / f"{number}.usdc"
        layer.Export(str(path))
        found.append(path.read_bytes())
    return found
