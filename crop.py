import rasterio, sys, cv2, numpy as np
# crop.py out.png x y w h scale file...
o,x,y,w,h,sc=sys.argv[1],*map(float,sys.argv[2:7]); rows=[]
for f in sys.argv[7:]:
    with rasterio.open(f) as r:
        a=r.read(window=rasterio.windows.Window(int(x),int(y),int(w),int(h)),out_shape=(4,int(h*sc),int(w*sc))) if w>0 else r.read(out_shape=(4,int(r.height*sc),int(r.width*sc)))
        print(f,r.width,r.height)
    a=a.transpose(1,2,0); rows.append(cv2.copyMakeBorder(np.where(a[...,3:]>0,a[...,2::-1],255).astype(np.uint8),0,0,0,6,cv2.BORDER_CONSTANT,value=(0,0,255)))
m=max(r.shape[0] for r in rows); rows=[cv2.copyMakeBorder(r,0,m-r.shape[0],0,0,cv2.BORDER_CONSTANT,value=(255,255,255)) for r in rows]
cv2.imwrite(o,np.hstack(rows))
