import pytest

from nerg_mi.rays.readers.columns import ColumnMap


@pytest.mark.parametrize(
    "text",
    [
        "origin=x,y,z direction=dx,dy,dz hit=hx,hy,hz t=time person=id confidence=c cohort=g",
        "origin=x,y,z wxyz=a,b,c,d t=time",
        "origin=x,y,z ypr=yaw,pitch",
        "direction=a,b,c matrix=" + ",".join(f"m{i}" for i in range(12)) + " eye=e,f,g",
        'origin=x,y,z direction=a,b,c "t=timestamp [ns]"',
        "origin=x,y,z azel=az,-el",
        'origin=x,y,z "yawpitch=-gaze yaw (rad),pitch" xyzw=a,b,c,d eye=e,f,g',
        r'origin=x,y,z direction=a,b,c "t=the \"time\" in \\s"',
        "origin=x,y,z direction=a,b,c head=qx,qy,qz,qw eyes=e,f,g,h,i,j",
    ],
)
def test_round_trip(text):
    columns = ColumnMap.parse(text)
    assert str(columns) == text and ColumnMap.parse(str(columns)) == columns


def test_order_of_fields_is_free():
    columns = ColumnMap.parse("direction=a,b,c origin=d,e,f")
    assert columns.origin == ("d", "e", "f") and columns.hit is None and columns.pose is None


@pytest.mark.parametrize(
    "text, message",
    [
        ("origin=x,y,z", "direction is missing"),
        ("direction=x,y,z", "origin is missing"),
        ("origin=x,y direction=a,b,c", "origin needs 3"),
        ("origin=x,y,z xyzw=a,b,c", "xyzw needs 4"),
        ("origin=x,y,z direction=a,b,c speed=v", "'speed' is unknown"),
        ("origin=x,y,z origin=x,y,z direction=a,b,c", "given twice"),
        ("origin=x,y,z xyzw=a,b,c,d ypr=e,f,g", "two poses"),
        ("origin=x,y,z direction=a,b,c azel=d,e", "direction and azel are two directions"),
        ("origin=x,y,z azel=d,e yawpitch=f,g", "azel and yawpitch are two directions"),
        ("origin=x,y,z azel=d", "azel needs 2"),
        ("origin=x,y,z matrix=" + ",".join("abcdefghijkl"), "leave out origin"),
        ("origin=x,y,z direction=a,b,c eye=e,f,g", "needs a pose"),
        ("origin=x,y,z direction=a,b,c xyzw=d,e,f,g head=h,i,j", "leave out head or xyzw"),
        ("origin=x,y,z xyzw=d,e,f,g head=h,i,j", "leave out head"),
        ("origin=x,y,x direction=a,b,c", "'x' has two roles"),
        ("origin=x,y,z direction=a,b,z", "'z' has two roles"),
        ("origin=x,y,z direction=a,b,c t=n person=n", "'n' has two roles"),
        ("origin=x,y,z azel=-x,el", "'x' has two roles"),
    ],
)
def test_refuses(text, message):
    with pytest.raises(ValueError, match=message):
        ColumnMap.parse(text)
