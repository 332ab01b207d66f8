// The few types of NetMQ that deploy/examples/plain/Feed.cs uses, over libzmq, with NetMQ's signatures: for the tests, where
// NetMQ itself is not there.

using System;
using System.Collections.Generic;
using System.IO;
using System.Runtime.InteropServices;

namespace NetMQ
{
    public interface IReceivingSocket
    {
        bool TryReceive(TimeSpan timeout, out byte[] frame, out bool more);
    }

    public static class ReceivingSocketExtensions
    {
        public static bool TryReceiveMultipartBytes(
            this IReceivingSocket socket, TimeSpan timeout, ref List<byte[]> frames, int expectedFrameCount = 4)
        {
            byte[] frame;
            bool more;
            if (!socket.TryReceive(timeout, out frame, out more))
                return false;
            if (frames == null)
                frames = new List<byte[]>(expectedFrameCount);
            else
                frames.Clear();
            frames.Add(frame);
            while (more)
            {
                if (!socket.TryReceive(TimeSpan.Zero, out frame, out more))
                    throw new IOException("a message without its end");
                frames.Add(frame);
            }
            return true;
        }
    }
}

namespace NetMQ.Sockets
{
    public class SubscriberSocket : IReceivingSocket, IDisposable
    {
        const int Sub = 2, SubscribeOption = 6, ReceiveMore = 13, ReceiveTimeout = 27, Linger = 17, TryAgain = 11;
        const int LargestBytes = 1 << 20;

        readonly IntPtr context = zmq_ctx_new();
        readonly IntPtr socket;
        readonly byte[] buffer = new byte[LargestBytes];

        public SubscriberSocket()
        {
            socket = zmq_socket(context, Sub);
            Set(Linger, 0);
        }

        public void Subscribe(byte[] topic)
        {
            Check(zmq_setsockopt(socket, SubscribeOption, topic, (UIntPtr)topic.Length));
        }

        public void Connect(string address)
        {
            Check(zmq_connect(socket, address));
        }

        public bool TryReceive(TimeSpan timeout, out byte[] frame, out bool more)
        {
            frame = null;
            more = false;
            Set(ReceiveTimeout, (int)timeout.TotalMilliseconds);
            int size = zmq_recv(socket, buffer, (UIntPtr)buffer.Length, 0);
            if (size < 0 && zmq_errno() == TryAgain)
                return false;
            Check(size);
            if (size > buffer.Length)
                throw new IOException("a frame of " + size + " bytes");
            frame = new byte[size];
            Array.Copy(buffer, frame, size);
            int value;
            var length = (UIntPtr)sizeof(int);
            Check(zmq_getsockopt(socket, ReceiveMore, out value, ref length));
            more = value != 0;
            return true;
        }

        public void Dispose()
        {
            Check(zmq_close(socket));
            Check(zmq_ctx_term(context));
        }

        void Set(int option, int value)
        {
            Check(zmq_setsockopt(socket, option, BitConverter.GetBytes(value), (UIntPtr)sizeof(int)));
        }

        static void Check(int result)
        {
            if (result < 0)
                throw new IOException(Marshal.PtrToStringAnsi(zmq_strerror(zmq_errno())));
        }

        [DllImport("zmq")] static extern IntPtr zmq_ctx_new();
        [DllImport("zmq")] static extern int zmq_ctx_term(IntPtr context);
        [DllImport("zmq")] static extern IntPtr zmq_socket(IntPtr context, int type);
        [DllImport("zmq")] static extern int zmq_close(IntPtr socket);
        [DllImport("zmq")] static extern int zmq_connect(IntPtr socket, string address);
        [DllImport("zmq")] static extern int zmq_setsockopt(IntPtr socket, int option, byte[] value, UIntPtr length);
        [DllImport("zmq")] static extern int zmq_getsockopt(IntPtr socket, int option, out int value, ref UIntPtr length);
        [DllImport("zmq")] static extern int zmq_recv(IntPtr socket, byte[] buffer, UIntPtr length, int flags);
        [DllImport("zmq")] static extern int zmq_errno();
        [DllImport("zmq")] static extern IntPtr zmq_strerror(int error);
    }
}
